"""Draws more of the pixels where a field is not right yet, and says by how much less each of these counts."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.dataset.views import Views

TILE_SIZE = 16
"""Pixels along a side of a tile, which has one error: smaller ones are met too seldom to know it."""
ERROR_WINDOW = 8
"""About how many of its last pixels a tile's error is the mean of."""
UPDATE_EVERY = 16
"""Steps between looks at all tiles."""
ERROR_SCALE = 2.0**30
"""Errors are summed as whole numbers, of this to one: sums do not depend on their order then, on any device."""
TOTAL_TICKETS = 1 << 40
"""About how many lots all tiles have together, likewise whole."""
STATE_KEYS = ("sums", "counts", "new_sums", "new_counts")
"""What a checkpoint keeps of each tile."""


class ErrorSampler:
    """Pixels drawn by the error of their surroundings: importance sampling, unbiased by weights.

    A pixel's chance is the sum of two: the same for all, and for a `fraction` of the draws in proportion to the mean error
    of the tile of its photo that it is in. A mean over pixels, each times its weight, is that over all known pixels: learning
    aims at the same, by gradients of less noise.

    Args:
        views: the photos; at least one pixel is known.
        fraction: of the draws that go by the error, in [0, 1).
    """

    def __init__(self, views: Views, fraction: float):
        self.views, self.fraction = views, fraction
        device = views.pixels.device
        sizes = views.cameras.sizes.to(device)
        self.tiles_per_row = (sizes[:, 0] + TILE_SIZE - 1) // TILE_SIZE
        self.tile_offsets = torch.cat(
            [sizes.new_zeros(1), (self.tiles_per_row * ((sizes[:, 1] + TILE_SIZE - 1) // TILE_SIZE)).cumsum(0)]
        )
        """Where each photo's tiles begin, and where the last's end."""
        tiles = int(self.tile_offsets[-1])
        _, _, widths, heights, _ = self._locate_tiles(torch.arange(tiles).to(device))
        self.valid_counts = widths * heights if views.valid_mask is None else self._count_valid()
        self.sums, self.counts = torch.zeros(tiles, device=device), torch.zeros(tiles, device=device)
        """Errors of the pixels that each tile remembers, and how many these are."""
        self.new_sums, self.new_counts = torch.zeros_like(self.valid_counts), torch.zeros_like(self.valid_counts)
        """Since the last look at all tiles; errors as whole numbers."""
        self.num_updates = 0
        self.last_tiles = self.valid_counts[:0]
        """Tiles of the last draw."""
        self._update_probabilities()

    def _locate_tiles(self, tiles: Int[Tensor, "T"]) -> tuple[Int[Tensor, "T"], ...]:
        """Of tiles: left, top, width, height in pixels, and photo."""
        view = torch.searchsorted(self.tile_offsets, tiles, right=True) - 1
        number, sizes = tiles - self.tile_offsets[view], self.views.cameras.sizes.to(tiles.device)[view]
        left, top = number % self.tiles_per_row[view] * TILE_SIZE, number // self.tiles_per_row[view] * TILE_SIZE
        return left, top, (sizes[:, 0] - left).clamp_max(TILE_SIZE), (sizes[:, 1] - top).clamp_max(TILE_SIZE), view

    def _count_valid(self) -> Int[Tensor, "T"]:
        """Known pixels in each tile."""
        counts = []
        for view in range(len(self.views)):
            mask = self.views.view_mask(view).long()
            height, width = mask.shape
            padded = torch.nn.functional.pad(mask, (0, -width % TILE_SIZE, 0, -height % TILE_SIZE))
            counts.append(padded.unflatten(0, (-1, TILE_SIZE)).unflatten(2, (-1, TILE_SIZE)).sum((1, 3)).flatten())
        return torch.cat(counts)

    def _update_probabilities(self) -> None:
        seen = self.counts > 0
        mean = self.sums.sum() / self.counts.sum().clamp_min(1)
        error = torch.where(seen, self.sums / self.counts.clamp_min(1), mean)
        known = self.valid_counts.float()
        alike, wrong = known / known.sum(), known * error
        by_error = torch.where(wrong.sum() > 0, wrong / wrong.sum().clamp_min(1e-30), alike)
        chance = (1 - self.fraction) * alike + self.fraction * by_error
        self.tickets = (chance * TOTAL_TICKETS).long().clamp_min(1) * (self.valid_counts > 0)
        self.ticket_ends = self.tickets.cumsum(0)
        self.num_tickets, self.num_valid = int(self.ticket_ends[-1]), int(self.valid_counts.sum())

    def draw(self, count: int, generator: torch.Generator) -> tuple[Int[Tensor, "R"], Float[Tensor, "R"]]:
        """Places in `Views.pixels`, and the weight of each: 0 for masked pixels in tiles that have known ones."""
        device = self.ticket_ends.device
        lot = torch.randint(self.num_tickets, (count,), generator=generator, device=device)
        self.last_tiles = tile = torch.searchsorted(self.ticket_ends, lot, right=True)
        left, top, width, height, view = self._locate_tiles(tile)
        across, down = torch.rand(2, count, generator=generator, device=device)
        column, row = left + (across * width).long(), top + (down * height).long()
        pixels = self.views.offsets[view] + row * self.views.widths[view] + column
        weights = (self.num_tickets / self.num_valid) * (width * height / self.tickets[tile])
        if self.views.valid_mask is not None:
            weights = weights * self.views.mask[pixels]
        return pixels, weights

    def update(self, errors: Float[Tensor, "R"], mask: Bool[Tensor, "R"] | None = None) -> None:
        """Called after each step with the error of each pixel of the last draw, 0 to 1, and which of them were measured."""
        measured = torch.ones_like(self.last_tiles) if mask is None else mask.to(self.last_tiles.device, torch.long)
        whole = (errors.detach().to(self.last_tiles.device).nan_to_num(1.0).clamp(0, 1) * ERROR_SCALE).long() * measured
        self.new_sums.index_add_(0, self.last_tiles, whole)
        self.new_counts.index_add_(0, self.last_tiles, measured)
        self.num_updates += 1
        if self.num_updates % UPDATE_EVERY:
            return
        self.sums += self.new_sums / ERROR_SCALE
        self.counts += self.new_counts
        kept = ERROR_WINDOW / self.counts.clamp_min(ERROR_WINDOW)
        self.sums, self.counts = self.sums * kept, self.counts * kept
        self.new_sums.zero_()
        self.new_counts.zero_()
        self._update_probabilities()

    def state_dict(self) -> dict[str, Tensor]:
        """All that later draws depend on."""
        return {name: getattr(self, name) for name in STATE_KEYS} | {"num_updates": torch.tensor(self.num_updates)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from `state_dict`; the photos are the same."""
        for name in STATE_KEYS:
            getattr(self, name).copy_(state[name])
        self.num_updates = int(state["num_updates"])
        self._update_probabilities()
