"""Error-guided pixel sampling with importance weights."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.dataset.views import Views

TILE_SIZE = 16
"""Tile side in pixels. Each tile has one running error; smaller tiles are sampled too rarely to estimate it."""
ERROR_WINDOW = 8
"""Samples in a tile's running mean error, approximately."""
UPDATE_EVERY = 16
"""Steps between updates of the sampling probabilities."""
ERROR_SCALE = 2.0**30
"""Fixed-point scale of summed errors: integer sums do not depend on their order, on any device."""
TOTAL_TICKETS = 1 << 40
"""Total integer tickets of all tiles, approximately (integers keep sampling deterministic)."""
STATE_KEYS = ("sums", "counts", "new_sums", "new_counts")
"""Tensors over all tiles in the checkpoint."""


class ErrorSampler:
    """Importance sampling of pixels by the error around them, unbiased by weights.

    Sampling probability = (1 - fraction) * uniform + fraction * (running mean error of the pixel's 16x16 tile). With the
    importance weights the loss estimates the uniform mean over all valid pixels, with gradients of lower variance.

    Args:
        views: photos with at least one valid pixel.
        fraction: fraction of the samples drawn by error, in [0, 1).
    """

    def __init__(self, views: Views, fraction: float):
        self.views, self.fraction = views, fraction
        device = views.pixels.device
        sizes = views.cameras.sizes.to(device)
        self.tiles_per_row, tiles_per_column = ((sizes + TILE_SIZE - 1) // TILE_SIZE).unbind(1)
        self.tile_offsets = torch.cat([sizes.new_zeros(1), (self.tiles_per_row * tiles_per_column).cumsum(0)])
        """Index of each photo's first tile, and the number of tiles."""
        tiles = int(self.tile_offsets[-1])
        _, _, widths, heights, _ = self._locate_tiles(torch.arange(tiles).to(device))
        self.valid_counts = widths * heights if views.valid_mask is None else self._count_valid()
        self.sums, self.counts = torch.zeros(tiles, device=device), torch.zeros(tiles, device=device)
        """Sum of the errors in each tile's running mean, and their number."""
        self.new_sums, self.new_counts = torch.zeros_like(self.valid_counts), torch.zeros_like(self.valid_counts)
        """Since the last update; errors in fixed point."""
        self.num_updates = 0
        self.pending: list[tuple[Tensor, Tensor, Tensor | None]] = []
        """Tiles, errors and masks that are not in `new_sums` yet: summed together, as each operation is a launch on a GPU."""
        self._update_probabilities()

    def _locate_tiles(self, tiles: Int[Tensor, "T"]) -> tuple[Int[Tensor, "T"], ...]:
        """Left, top, width and height of tiles in pixels, and their photos."""
        view = torch.searchsorted(self.tile_offsets, tiles, right=True) - 1
        number, sizes = tiles - self.tile_offsets[view], self.views.cameras.sizes.to(tiles.device)[view]
        left, top = number % self.tiles_per_row[view] * TILE_SIZE, number // self.tiles_per_row[view] * TILE_SIZE
        return left, top, (sizes[:, 0] - left).clamp_max(TILE_SIZE), (sizes[:, 1] - top).clamp_max(TILE_SIZE), view

    def _count_valid(self) -> Int[Tensor, "T"]:
        """Counts the valid pixels in each tile."""
        counts = []
        for view in range(len(self.views)):
            mask = self.views.view_mask(view).long()
            height, width = mask.shape
            padded = torch.nn.functional.pad(mask, (0, -width % TILE_SIZE, 0, -height % TILE_SIZE))
            counts.append(padded.unflatten(0, (-1, TILE_SIZE)).unflatten(2, (-1, TILE_SIZE)).sum((1, 3)).flatten())
        return torch.cat(counts)

    def _update_probabilities(self) -> None:
        mean = self.sums.sum() / self.counts.sum().clamp_min(1)
        error = torch.where(self.counts > 0, self.sums / self.counts.clamp_min(1), mean)
        valid = self.valid_counts.float()
        uniform, total_error = valid / valid.sum(), valid * error
        by_error = torch.where(total_error.sum() > 0, total_error / total_error.sum().clamp_min(1e-30), uniform)
        probability = (1 - self.fraction) * uniform + self.fraction * by_error
        self.tickets = (probability * TOTAL_TICKETS).long().clamp_min(1) * (self.valid_counts > 0)
        self.ticket_ends = self.tickets.cumsum(0)
        self.num_tickets, self.num_valid = int(self.ticket_ends[-1]), int(self.valid_counts.sum())

    def draw(
        self, count: int, generator: torch.Generator
    ) -> tuple[Int[Tensor, "R"], Float[Tensor, "R"], Int[Tensor, "R"]]:
        """Samples indices into `Views.pixels`, their weights (0 for masked pixels in tiles with valid ones), and tiles."""
        device = self.ticket_ends.device
        ticket = torch.randint(self.num_tickets, (count,), generator=generator, device=device)
        tile = torch.searchsorted(self.ticket_ends, ticket, right=True)
        left, top, width, height, view = self._locate_tiles(tile)
        u, v = torch.rand(2, count, generator=generator, device=device)
        column, row = left + (u * width).long(), top + (v * height).long()
        pixels = self.views.offsets[view] + row * self.views.widths[view] + column
        weights = (self.num_tickets / self.num_valid) * (width * height / self.tickets[tile])
        if self.views.valid_mask is not None:
            weights = weights * self.views.mask[pixels]
        return pixels, weights, tile

    def update(
        self, tiles: Int[Tensor, "R"], errors: Float[Tensor, "R"], mask: Bool[Tensor, "R"] | None = None
    ) -> None:
        """Records the errors of samples in tiles, in [0, 1]; `mask` is False where none was measured."""
        self.pending.append((tiles, errors.detach(), mask))
        self.num_updates += 1
        if self.num_updates % UPDATE_EVERY:
            return
        self._sum_pending()
        self.sums += self.new_sums / ERROR_SCALE
        self.counts += self.new_counts
        decay = ERROR_WINDOW / self.counts.clamp_min(ERROR_WINDOW)
        self.sums, self.counts = self.sums * decay, self.counts * decay
        self.new_sums.zero_()
        self.new_counts.zero_()
        self._update_probabilities()

    def _sum_pending(self) -> None:
        if self.pending:
            masks = [torch.ones_like(errors) if mask is None else mask for _, errors, mask in self.pending]
            device, (tiles, errors, _) = self.new_sums.device, zip(*self.pending, strict=True)
            tile, error, measured = (
                torch.cat(tiles),
                torch.cat(errors).to(device),
                torch.cat(masks).to(device, torch.long),
            )
            fixed_point = (error.nan_to_num(1.0).clamp(0, 1) * ERROR_SCALE).long()
            self.new_sums.index_add_(0, tile, fixed_point * measured)
            self.new_counts.index_add_(0, tile, measured)
            self.pending = []

    def state_dict(self) -> dict[str, Tensor]:
        """Everything that later samples depend on."""
        self._sum_pending()
        return {name: getattr(self, name) for name in STATE_KEYS} | {"num_updates": torch.tensor(self.num_updates)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restores `state_dict`, for the same photos."""
        for name in STATE_KEYS:
            getattr(self, name).copy_(state[name])
        self.num_updates = int(state["num_updates"])
        self._update_probabilities()
