"""NeRF2D: fit a picture with a coordinate network."""

import torch
from torch import Tensor

from nerf_lightning.dataset import PictureBatch, PixelBatch
from nerf_lightning.model import PictureField
from nerf_lightning.system.system import MakeOptimizer, Schedule, StepStats, System

RENDER_CHUNK = 1 << 16
"""Pixels rendered together without gradient."""


class NeRF2D(System):
    """field -> squared error.

    Args:
        field: place -> rgb.
        optimizer, schedule, seed: see `System`.
    """

    def __init__(self, field: PictureField, optimizer: MakeOptimizer, schedule: Schedule, seed: int = 0):
        super().__init__(optimizer, schedule, seed)
        self.field = field

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        loss = torch.nn.functional.mse_loss(self.field(batch.uv), batch.rgb)
        self.stats = StepStats(loss.detach().item(), len(batch.uv), len(batch.uv))
        return loss

    def truth(self, view: PictureBatch) -> Tensor:
        return view.rgb

    def show(self, view: PictureBatch) -> tuple[Tensor, None, None]:
        return torch.cat([self.field(part) for part in view.uv.split(RENDER_CHUNK)]), None, None
