"""A field whose surface is known: a ball of a colour that depends on where one looks from."""

from pathlib import Path

import torch
from omegaconf import OmegaConf

from nerf_lightning.cameras import Bounds, Cameras, orbit_around
from nerf_lightning.config.build import SceneFrame, build_system
from nerf_lightning.config.compose import composed
from nerf_lightning.model import Field
from nerf_lightning.runs.open import SceneRun
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


def ball_run(to_source: torch.Tensor) -> SceneRun:
    """The same as a run that was looked at from above and from below."""
    K = torch.tensor([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
    up = torch.tensor([0.0, 0.0, 1.0])
    poses = torch.cat([orbit_around(CENTRE, up, 3.0, elevation, 8) for elevation in (-0.6, 0.6)])
    orbit = Cameras.of_size(K.repeat(16, 1, 1), poses, 32, 24)
    return SceneRun(OmegaConf.create(), ball_system(), orbit, to_source, {})
