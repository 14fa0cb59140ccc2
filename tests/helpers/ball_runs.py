"""A field whose surface is known: a ball of a color that depends on where one looks from."""

from pathlib import Path

import torch
from omegaconf import OmegaConf

from nerf_lightning.cameras import Bounds, Cameras, make_circle_poses
from nerf_lightning.config.build import SceneMetadata, build_system
from nerf_lightning.config.compose import compose_config
from nerf_lightning.model import Field
from nerf_lightning.runs.open import LoadedSceneRun
from nerf_lightning.system import NeRF3D

MAX_DENSITY = 80.0
CENTER, RADIUS, SHARPNESS = torch.tensor([0.1, -0.2, 0.05]), 0.6, 100.0


class BallField(Field):
    """Density rises from outside to inside within a hundredth or two; red from above, blue from below."""

    def features(self, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        depth = RADIUS - (positions - CENTER).norm(dim=1)
        return MAX_DENSITY * torch.sigmoid(SHARPNESS * depth), positions

    def color(self, features: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
        red = (1 - directions[:, 2]) / 2
        return torch.stack([red, torch.zeros_like(red), 1 - red], dim=1)


def make_ball_system() -> NeRF3D:
    """A system with that field, and a sampler without a grid."""
    bounds = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    cfg = compose_config(["sampler=uniform"], Path("unused"))
    system = build_system(cfg, SceneMetadata(bounds, (0.0, 0.0, 0.0)))
    assert isinstance(system, NeRF3D)
    system.field = BallField(bounds)
    return system.eval()


def make_ball_run(to_source: torch.Tensor) -> LoadedSceneRun:
    """The same as a run that was looked at from above and from below."""
    K = torch.tensor([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
    up = torch.tensor([0.0, 0.0, 1.0])
    poses = torch.cat([make_circle_poses(CENTER, up, 3.0, elevation, 8) for elevation in (-0.6, 0.6)])
    orbit = Cameras.pinhole(K.repeat(16, 1, 1), poses, 32, 24)
    return LoadedSceneRun(OmegaConf.create(), make_ball_system(), orbit, to_source, {})
