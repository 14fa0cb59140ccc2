"""NeRF2D: fits a coordinate network to an image."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.dataset import PictureBatch, PixelBatch
from nerf_lightning.model import PictureField
from nerf_lightning.system.metrics import psnr
from nerf_lightning.system.system import StepStats, System

PIXELS_PER_CHUNK_SAMPLE = 2
"""Pixels rendered at once per sample of `chunk`."""
MAX_OFF_GRID_POINTS = 1 << 20
"""Pixel corners evaluated, about, at most."""


class NeRF2D(System):
    """Field trained with squared error; arguments as `System`."""

    field: PictureField

    def lr_factors(self, progress: float, step: int) -> dict[str, float]:
        return {"field": self.field.lr_scale * self.schedule(progress, step)}

    def loss(self, batch: PixelBatch) -> Float[Tensor, ""]:
        """Mean squared error of the batch."""
        rgb = self.field(batch.uv)
        return torch.nn.functional.mse_loss(rgb, batch.rgb)

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        loss = self.loss(batch)
        self.stats = StepStats(loss.detach(), len(batch.uv), len(batch.uv), losses={"photometric": loss.detach()})
        return loss

    def compute_losses(self, batch: PixelBatch, generator: torch.Generator) -> tuple[dict[str, Tensor], StepStats]:
        return {"photometric": self.loss(batch)}, self.stats

    def compute_target_rgb(self, batch: PixelBatch, is_training: bool = False) -> Tensor:
        return batch.rgb

    def render_view(self, view: PictureBatch) -> tuple[Tensor, None, None]:
        return self.query_rgb(view.uv), None, None

    @torch.no_grad()
    def query_rgb(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        """Field colors at `uv`, clamped to [0, 1], evaluated in chunks."""
        rgb, size = uv.new_empty(len(uv), 3), PIXELS_PER_CHUNK_SAMPLE * self.chunk
        for target, points in zip(rgb.split(size), uv.split(size), strict=True):
            target.copy_(self.field(points).clamp(0, 1))
        return rgb

    def measure_off_grid_psnr(self, view: PictureBatch) -> float | None:
        """PSNR at pixel corners against the mean of their four pixels; far below the pixels' own PSNR, the field overfits.

        None for an image of one row or column.
        """
        columns, corners = view.width - 1, (view.width - 1) * (view.height - 1)
        if not corners:
            return None
        corner = torch.arange(0, corners, 1 + corners // MAX_OFF_GRID_POINTS, device=view.uv.device)
        first = corner // columns * view.width + corner % columns
        offsets = (0, 1, view.width, view.width + 1)
        uv, rgb = (torch.stack([x[first + offset] for offset in offsets]).mean(0) for x in (view.uv, view.rgb))
        return psnr(self.query_rgb(uv), rgb)

    def diagnose(self, view: PictureBatch) -> str:
        rgb = self.query_rgb(view.uv)
        is_constant = (rgb.amax(0) - rgb.amin(0)).max() <= 1 / 255
        return "the field has the same color everywhere: lower the learning rate" if is_constant else ""
