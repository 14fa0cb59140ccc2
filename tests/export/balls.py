"""A field whose surface is known: a ball of a colour that depends on where one looks from."""

from pathlib import Path

import torch

from nerf_lightning.build import SceneFrame, build_system
from nerf_lightning.cameras import Bounds
from nerf_lightning.compose import composed
from nerf_lightning.model import Field
from nerf_lightning.system import NeRF3D

DENSE = 80.0
CENTRE, RADIUS, STEEP = torch.tensor([0.1, -0.2, 0.05]), 0.6, 100.0


class BallField(Field):
    """Density rises from outside to inside within a hundredth or two; red from above, blue from below."""

    def features(self, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        depth = RADIUS - (positions - CENTRE).norm(dim=1)
        return DENSE * torch.sigmoid(STEEP * depth), positions

    def colour(self, features: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        red = (1 - directions[:, 2]) / 2
        return torch.stack([red, torch.zeros_like(red), 1 - red], dim=1)


def ball_system() -> NeRF3D:
    """A system with that field, and a sampler without a grid."""
    bounds = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    cfg = composed(["sampler=uniform"], Path("unused"))
    system = build_system(cfg, SceneFrame(bounds, (0.0, 0.0, 0.0)))
    assert isinstance(system, NeRF3D)
    system.field = BallField(bounds)
    return system.eval()
