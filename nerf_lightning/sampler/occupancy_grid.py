"""An occupancy grid: which cells of the bounds hold something that light can reach (Instant-NGP, appendix C)."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from nerf_lightning.cameras import BoundedModule, Bounds, Cameras
from nerf_lightning.kernels import mark_cells

MAX_CAMERAS = 128
"""That decide which cells are in view, evenly chosen."""
LATTICE_SIZE = 1 << 24
"""Positions along an axis of a cell: as many as single precision tells apart."""
R3_BASE = 1.2207440846057596
"""The root above 1 of x^4 = x + 1."""


def r3_sequence(numbers: Int[Tensor, "N"], generator: Generator) -> Float[Tensor, "3 N"]:
    """The additive recurrence R3 (Roberts 2018), shifted at random: a position in [0, 1)^3 for each whole number.

    For a million cells this takes a fraction of the time of as many random numbers.
    """
    device = numbers.device
    steps = [[round(LATTICE_SIZE / R3_BASE**power)] for power in (1, 2, 3)]
    start = torch.randint(LATTICE_SIZE, (3, 1), generator=generator, device=device, dtype=torch.int32)
    # What overflows is beyond the bits that count.
    lattice = (numbers * torch.tensor(steps, dtype=torch.int32, device=device) + start) & (LATTICE_SIZE - 1)
    return lattice / LATTICE_SIZE


class OccupancyGrid(BoundedModule):
    """Cells of the bounds with a decaying maximum of the optical depth of a step, found at random positions in each.

    Args:
        bounds: where the content is.
        resolution: cells along each side.
        threshold: optical depth of a step above which a cell is occupied, or half the mean of all, whichever is lower.
        decay: factor on a cell's maximum at each update.
        visibility_window: updates after which an occupied cell that light no longer reaches is not active.
    """

    optical_depth: Tensor
    occupied: Tensor
    in_view: Tensor
    """Cells that enough training cameras see; the others stay empty."""
    last_visible: Tensor
    """The last update before light met the cell."""
    active: Tensor
    """Occupied cells that light reached lately."""

    def __init__(self, bounds: Bounds, resolution: int, threshold: float, decay: float, visibility_window: int):
        super().__init__(bounds)
        self.resolution = resolution
        self.threshold = threshold
        self.decay = decay
        self.visibility_window = visibility_window
        cells = resolution**3
        self.register_buffer("optical_depth", torch.zeros(cells))
        self.register_buffer("occupied", torch.ones(cells, dtype=torch.bool))
        self.register_buffer("in_view", torch.ones(cells, dtype=torch.bool))
        self.register_buffer("last_visible", torch.zeros(cells, dtype=torch.int32))
        self.register_buffer("active", torch.ones(cells, dtype=torch.bool))

    @property
    def device(self) -> torch.device:
        return self.occupied.device

    def mean_active_depth(self) -> Float[Tensor, ""]:
        """Mean optical depth of a step in an active cell."""
        return (self.optical_depth * self.active).sum() / self.active.sum()

    def mark_visible(self, positions: Float[Tensor, "N 3"], update: int) -> None:
        """Notes that light reached these world positions after this update."""
        mark_cells(self.last_visible, update, self.bounds, positions)

    @torch.no_grad()
    def mark_invisible_cells(self, cameras: Cameras, min_cameras: int) -> None:
        """Empties for good the cells whose middle fewer than `min_cameras` cameras see."""
        chosen = torch.linspace(0, len(cameras) - 1, min(len(cameras), MAX_CAMERAS)).round().long()
        n = self.resolution
        cells = torch.arange(n**3)
        unit = (torch.stack([cells // (n * n), cells // n % n, cells % n], dim=1) + 0.5) / n
        bounds = self.bounds.to("cpu")
        middles, near = bounds.to_world(unit), self.bounds.near or 0.0
        count = torch.zeros(len(cells), dtype=torch.int32)
        wanted = min(min_cameras, len(chosen))
        for camera in chosen:
            open_ones = (count < wanted).nonzero()[:, 0]  # the others have enough views already
            points, one = middles[open_ones], cameras[camera : camera + 1].to("cpu")
            count[open_ones] += (one.project(points, 0)[2] & ((points - one.centres).norm(dim=1) > near)).int()
        in_view = count >= wanted
        self.in_view.copy_(in_view if in_view.any() else torch.ones_like(in_view))
        self.occupied &= self.in_view
        self.active &= self.in_view

    @torch.no_grad()
    def update(
        self,
        number: int,
        optical_depth: Callable[[Float[Tensor, "N 3"]], Float[Tensor, "N"]],
        all_cells: bool,
        generator: Generator,
    ) -> None:
        """Looks at a random position in every cell, or in a quarter of them.

        Args:
            number: of the update.
            optical_depth: of a step at world positions.
            all_cells: whether in every one.
            generator: of the positions.
        """
        n, total = self.resolution, self.resolution**3
        cells = torch.arange(0, total, 1 if all_cells else 4, device=self.device)
        if not all_cells:  # every fourth cell from a random start: no cell twice, all equally likely
            cells = cells + torch.randint(4, (1,), generator=generator, device=self.device)
            cells = torch.where(cells < total, cells, cells - total)
        index = cells.int() if total < 1 << 31 else cells  # 32 bits are divided in a fraction of the time
        row = index // n
        plane = row // n
        corner = torch.stack([plane, row - plane * n, index - row * n])
        unit = ((corner + r3_sequence(index, generator)) / n).T
        found = optical_depth(self.bounds.to_world(unit))
        self.optical_depth[cells] = torch.maximum(self.optical_depth[cells] * self.decay, found)
        occupied = self.in_view & (self.optical_depth > self.optical_depth.mean().mul(0.5).clamp_max(self.threshold))
        # Without any density there would be no samples, so no gradient, forever: look everywhere again.
        self.occupied = torch.where(occupied.any(), occupied, self.in_view)
        self.active = self.occupied & (self.last_visible >= number - self.visibility_window)

    @torch.no_grad()
    def resize(self, resolution: int) -> None:
        """Takes another resolution: a cell holds whatever the cells that it lies in held."""
        old, self.resolution = self.resolution, resolution
        edges = torch.arange(resolution + 1, device=self.device) * old
        first, last = edges[:-1] // resolution, (edges[1:] - 1) // resolution
        for name, cells in list(self.named_buffers()):
            grid = cells.view(old, old, old)
            for axis in range(3):
                grid = torch.maximum(grid.index_select(axis, first), grid.index_select(axis, last))
            setattr(self, name, grid.flatten())

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        """Takes the resolution of the loaded state, which may come from another stage of training."""
        cells = state_dict.get(f"{prefix}occupied", self.occupied).numel()
        if (side := round(cells ** (1 / 3))) != self.resolution and side**3 == cells:
            self.resize(side)
        super()._load_from_state_dict(state_dict, prefix, *rest)
