"""Draws more of the pixels where a field is not right yet, and says by how much less each of these counts."""

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.dataset.views import Views

SIDE = 16
"""Pixels along a side of a tile, which has one error: smaller ones are met too seldom to know it."""
REMEMBERED = 8
"""About how many of its last pixels a tile's error is the mean of."""
EVERY = 16
"""Steps between looks at all tiles."""
WHOLE = 2.0**30
"""Errors are summed as whole numbers, of this to one: sums do not depend on their order then, on any device."""
LOTS = 1 << 40
"""About how many lots all tiles have together, likewise whole."""
KEPT = ("sums", "counts", "new_sums", "new_counts")
"""What a checkpoint keeps of each tile."""


class Focus:
    """Pixels drawn by the error of their surroundings: importance sampling, unbiased by weights.

    A pixel's chance is the sum of two: the same for all, and for the other `share` of the draws in proportion to the mean error
    of the tile of its photo that it is in. A mean over pixels, each times its weight, is that over all known pixels: learning
    aims at the same, by gradients of less noise.

    Args:
        views: the photos; at least one pixel is known.
        share: of the draws that go by the error, in [0, 1).
    """

    def __init__(self, views: Views, share: float):
        self.views, self.share = views, share
        device = views.pixels.device
        sizes = views.cameras.sizes.to(device)
        self.across = (sizes[:, 0] + SIDE - 1) // SIDE
        self.first = torch.cat([sizes.new_zeros(1), (self.across * ((sizes[:, 1] + SIDE - 1) // SIDE)).cumsum(0)])
        """Where each photo's tiles begin, and where the last's end."""
        tiles = int(self.first[-1])
        _, _, widths, heights, _ = self._places(torch.arange(tiles).to(device))
        self.known = widths * heights if views.known is None else self._known()
        self.sums, self.counts = torch.zeros(tiles, device=device), torch.zeros(tiles, device=device)
        """Errors of the pixels that each tile remembers, and how many these are."""
        self.new_sums, self.new_counts = torch.zeros_like(self.known), torch.zeros_like(self.known)
        """Since the last look at all tiles; errors as whole numbers."""
        self.noted = 0
        self.drawn = self.known[:0]
        """Tiles of the last draw."""
        self._set_chances()

    def _places(self, tiles: Int[Tensor, "T"]) -> tuple[Int[Tensor, "T"], ...]:
        """Of tiles: left, top, width, height in pixels, and photo."""
        view = torch.searchsorted(self.first, tiles, right=True) - 1
        number, sizes = tiles - self.first[view], self.views.cameras.sizes.to(tiles.device)[view]
        left, top = number % self.across[view] * SIDE, number // self.across[view] * SIDE
        return left, top, (sizes[:, 0] - left).clamp_max(SIDE), (sizes[:, 1] - top).clamp_max(SIDE), view

    def _known(self) -> Int[Tensor, "T"]:
        """Known pixels in each tile."""
        counts = []
        for view in range(len(self.views)):
            mask = self.views.mask_of(view).long()
            height, width = mask.shape
            padded = torch.nn.functional.pad(mask, (0, -width % SIDE, 0, -height % SIDE))
            counts.append(padded.unflatten(0, (-1, SIDE)).unflatten(2, (-1, SIDE)).sum((1, 3)).flatten())
        return torch.cat(counts)

    def _set_chances(self) -> None:
        seen = self.counts > 0
        mean = self.sums.sum() / self.counts.sum().clamp_min(1)
        error = torch.where(seen, self.sums / self.counts.clamp_min(1), mean)
        known = self.known.float()
        alike, wrong = known / known.sum(), known * error
        by_error = torch.where(wrong.sum() > 0, wrong / wrong.sum().clamp_min(1e-30), alike)
        chance = (1 - self.share) * alike + self.share * by_error
        self.lots = (chance * LOTS).long().clamp_min(1) * (self.known > 0)
        self.ends = self.lots.cumsum(0)
        self.all_lots, self.all_known = int(self.ends[-1]), int(self.known.sum())

    def draw(self, count: int, generator: torch.Generator) -> tuple[Int[Tensor, "R"], Float[Tensor, "R"]]:
        """Places in `Views.pixels`, and the weight of each: 0 for masked pixels in tiles that have known ones."""
        device = self.ends.device
        lot = torch.randint(self.all_lots, (count,), generator=generator, device=device)
        self.drawn = tile = torch.searchsorted(self.ends, lot, right=True)
        left, top, width, height, view = self._places(tile)
        across, down = torch.rand(2, count, generator=generator, device=device)
        column, row = left + (across * width).long(), top + (down * height).long()
        places = self.views.starts[view] + row * self.views.widths[view] + column
        weights = (self.all_lots / self.all_known) * (width * height / self.lots[tile])
        if self.views.known is not None:
            weights = weights * self.views.mask[places]
        return places, weights

    def note(self, errors: Float[Tensor, "R"], counted: Bool[Tensor, "R"] | None = None) -> None:
        """Called after each step with the error of each pixel of the last draw, 0 to 1, and which of them were measured."""
        measured = torch.ones_like(self.drawn) if counted is None else counted.to(self.drawn.device, torch.long)
        whole = (errors.detach().to(self.drawn.device).nan_to_num(1.0).clamp(0, 1) * WHOLE).long() * measured
        self.new_sums.index_add_(0, self.drawn, whole)
        self.new_counts.index_add_(0, self.drawn, measured)
        self.noted += 1
        if self.noted % EVERY:
            return
        self.sums += self.new_sums / WHOLE
        self.counts += self.new_counts
        kept = REMEMBERED / self.counts.clamp_min(REMEMBERED)
        self.sums, self.counts = self.sums * kept, self.counts * kept
        self.new_sums.zero_()
        self.new_counts.zero_()
        self._set_chances()

    def state_dict(self) -> dict[str, Tensor]:
        """All that later draws depend on."""
        return {name: getattr(self, name) for name in KEPT} | {"noted": torch.tensor(self.noted)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from `state_dict`; the photos are the same."""
        for name in KEPT:
            getattr(self, name).copy_(state[name])
        self.noted = int(state["noted"])
        self._set_chances()
