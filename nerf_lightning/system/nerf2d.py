"""NeRF2D: fit a picture with a coordinate network."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.dataset import PictureBatch, PixelBatch
from nerf_lightning.model import PictureField
from nerf_lightning.sampler import CHUNK
from nerf_lightning.system.compiled import part
from nerf_lightning.system.metrics import psnr
from nerf_lightning.system.state import TrainingState
from nerf_lightning.system.system import MakeOptimizer, Schedule, StepStats, System

PIXELS = 2
"""Pixels rendered at once for each sample of `chunk`."""
LOOKED = 1 << 16
"""About how many pixels ReLUs are tested at."""
CORNERS = 1 << 20
"""About how many corners between pixels are looked at."""
SATURATED = 1 / 255
"""A sigmoid this close to 0 or 1 has less than a fiftieth of its largest slope."""


class NeRF2D(System):
    """field -> squared error.

    Args:
        field: place -> rgb.
        optimizer, schedule, seed, chunk, backend, state: see `System`.
    """

    field: PictureField

    def __init__(
        self,
        field: PictureField,
        optimizer: MakeOptimizer,
        schedule: Schedule,
        seed: int = 0,
        chunk: int = CHUNK,
        backend: str | None = None,
        state: TrainingState | None = None,
    ):
        super().__init__(optimizer, schedule, seed, chunk, backend, state)
        self.field = field

    def lr_factors(self, progress: float, step: int) -> dict[str, float]:
        return {"field": self.field.rate * self.schedule(progress, step)}

    def loss(self, batch: PixelBatch) -> Float[Tensor, ""]:
        """What a step minimises."""
        return torch.nn.functional.mse_loss(part(self.field.forward, self.backend)(batch.uv), batch.rgb)

    def training_step(self, batch: PixelBatch, batch_idx: int) -> Tensor:
        loss = self.loss(batch)
        self.stats = StepStats(loss.detach(), len(batch.uv), len(batch.uv), losses={"photometric": loss.detach()})
        return loss

    def compute_losses(self, batch: PixelBatch, generator: torch.Generator) -> tuple[dict[str, Tensor], StepStats]:
        return {"photometric": self.loss(batch)}, self.stats

    def truth(self, batch: PixelBatch) -> Tensor:
        return batch.rgb

    def show(self, view: PictureBatch) -> tuple[Tensor, None, None]:
        return self.colours(view.uv), None, None

    @torch.no_grad()
    def colours(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        """The field's colours at any places, a chunk at a time, clamped to [0, 1]."""
        colours = uv.new_empty(len(uv), 3)
        for some, places in zip(colours.split(PIXELS * self.chunk), uv.split(PIXELS * self.chunk), strict=True):
            some.copy_(self.field(places).clamp(0, 1))
        return colours

    def between(self, view: PictureBatch) -> float | None:
        """PSNR at corners where four pixels meet, against their mean: if far below that of the pixels, the field overfits.

        None for a picture of one row or one column.
        """
        across, corners = view.width - 1, (view.width - 1) * (view.height - 1)
        if not corners:
            return None
        corner = torch.arange(0, corners, 1 + corners // CORNERS, device=view.uv.device)
        first = corner // across * view.width + corner % across
        around = (0, 1, view.width, view.width + 1)
        uv, rgb = (torch.stack([x[first + next] for next in around]).mean(0) for x in (view.uv, view.rgb))
        return psnr(self.colours(uv), rgb)

    @torch.no_grad()
    def diagnose(self, view: PictureBatch) -> str:
        rgb = self.colours(view.uv)
        if (rgb.amax(0) - rgb.amin(0)).max() > 1 / 255:
            return ""
        causes = []
        dead = max(dead_relus(self.field, view.uv), default=0.0)
        if dead >= 0.5:
            causes.append(f"{dead:.0%} of a layer's ReLUs are off everywhere, so no gradient reaches them")
        raw = self.field(view.uv[:1])
        if ((raw - 0.5).abs() <= 0.5).all() and ((raw - 0.5).abs() > 0.5 - SATURATED).all():
            causes.append("all its values are at the ends of their range, where a sigmoid has hardly any slope")
        if not causes:
            return "every place gets the same colour"
        return f"every place gets the same colour: {'; '.join(causes)}; a lower learning rate avoids that"


@torch.no_grad()
def dead_relus(field: PictureField, uv: Float[Tensor, "N 2"]) -> list[float]:
    """For each ReLU layer of a field, the share of units that are off at every place."""
    alive: list[Tensor] = []
    layers = [module for module in field.modules() if isinstance(module, torch.nn.ReLU)]
    hooks = [layer.register_forward_hook(lambda _, __, out: alive.append((out > 0).any(0))) for layer in layers]
    field(uv[:: max(1, len(uv) // LOOKED)])
    for hook in hooks:
        hook.remove()
    return [1 - float(units.float().mean()) for units in alive]
