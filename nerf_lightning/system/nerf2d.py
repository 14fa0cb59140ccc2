"""NeRF2D: fit a picture with a coordinate network."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.dataset import PictureBatch, PixelBatch
from nerf_lightning.model import PictureField
from nerf_lightning.system.metrics import psnr
from nerf_lightning.system.system import StepStats, System
from nerf_lightning.system.torch_compile import maybe_compile

PIXELS_PER_CHUNK_SAMPLE = 2
"""Rendered at once, for each sample of `chunk`."""
MAX_OFF_GRID_POINTS = 1 << 20
"""About how many corners between pixels are looked at."""


class NeRF2D(System):
    """field -> squared error; arguments as `System`."""

    field: PictureField

    def lr_factors(self, progress: float, step: int) -> dict[str, float]:
        return {"field": self.field.lr_scale * self.schedule(progress, step)}

    def loss(self, batch: PixelBatch) -> Float[Tensor, ""]:
        """What a step minimises."""
        return torch.nn.functional.mse_loss(
            maybe_compile(self.field.forward, self.compile_backend)(batch.uv), batch.rgb
        )

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        loss = self.loss(batch)
        self.stats = StepStats(loss.detach(), len(batch.uv), len(batch.uv), losses={"photometric": loss.detach()})
        return loss

    def compute_losses(self, batch: PixelBatch, generator: torch.Generator) -> tuple[dict[str, Tensor], StepStats]:
        return {"photometric": self.loss(batch)}, self.stats

    def compute_target_rgb(self, batch: PixelBatch) -> Tensor:
        return batch.rgb

    def render_view(self, view: PictureBatch) -> tuple[Tensor, None, None]:
        return self.query_rgb(view.uv), None, None

    @torch.no_grad()
    def query_rgb(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        """The field's colours at any places, a chunk at a time, clamped to [0, 1]."""
        colours = uv.new_empty(len(uv), 3)
        for target, points in zip(
            colours.split(PIXELS_PER_CHUNK_SAMPLE * self.chunk),
            uv.split(PIXELS_PER_CHUNK_SAMPLE * self.chunk),
            strict=True,
        ):
            target.copy_(self.field(points).clamp(0, 1))
        return colours

    def measure_off_grid_psnr(self, view: PictureBatch) -> float | None:
        """PSNR at corners where four pixels meet, against their mean: if far below that of the pixels, the field overfits.

        None for a picture of one row or one column.
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
        is_plain = (rgb.amax(0) - rgb.amin(0)).max() <= 1 / 255
        return "every place gets the same colour, which a lower learning rate avoids" if is_plain else ""
