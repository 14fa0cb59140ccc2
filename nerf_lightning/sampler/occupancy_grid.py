"""Occupancy grid: occupied and recently visible cells of the bounds (Instant-NGP, appendix C)."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from nerf_lightning.cameras import BoundedModule, Bounds, Cameras
from nerf_lightning.kernels import mark_cells

MAX_CAMERAS = 128
"""Maximum number of (evenly spaced) cameras tested for visibility."""
LATTICE_SIZE = 1 << 24
"""Positions along an axis of a cell: the resolution of float32."""
R3_BASE = 1.2207440846057596
"""Root above 1 of x^4 = x + 1."""


def r3_sequence(numbers: Int[Tensor, "N"], generator: Generator) -> Float[Tensor, "3 N"]:
    """Low-discrepancy sequence R3 (Roberts 2018) with a random shift: positions in [0, 1)^3; faster than random numbers."""
    device = numbers.device
    steps = [[round(LATTICE_SIZE / R3_BASE**power)] for power in (1, 2, 3)]
    start = torch.randint(LATTICE_SIZE, (3, 1), generator=generator, device=device, dtype=torch.int32)
    # Overflow only affects bits that the mask removes.
    lattice = (numbers * torch.tensor(steps, dtype=torch.int32, device=device) + start) & (LATTICE_SIZE - 1)
    return lattice / LATTICE_SIZE


class OccupancyGrid(BoundedModule):
    """Cubic grid with a decaying maximum per cell of the optical depth of a step at random positions.

    Args:
        bounds: the box of the content.
        resolution: cells along each side.
        threshold: a cell is occupied while its optical depth exceeds min(threshold, mean / 2).
        decay: factor on a cell's maximum at each update.
        visibility_window: updates after which an occupied cell without visible samples is no longer active.
    """

    optical_depth: Tensor
    occupied: Tensor
    in_view: Tensor
    """Cells in view of enough training cameras; the others stay empty."""
    last_visible: Tensor
    """Number of the last update before the cell held a visible sample."""
    active: Tensor
    """Occupied, recently visible cells."""

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
        """Records visible samples (world positions) after this update."""
        mark_cells(self.last_visible, update, self.bounds, positions)

    @torch.no_grad()
    def mark_invisible_cells(self, cameras: Cameras, min_cameras: int) -> None:
        """Permanently empties cells whose center is in view of fewer than `min_cameras` cameras."""
        camera_indices = torch.linspace(0, len(cameras) - 1, min(len(cameras), MAX_CAMERAS)).round().long()
        n = self.resolution
        cells = torch.arange(n**3)
        unit = (torch.stack([cells // (n * n), cells // n % n, cells % n], dim=1) + 0.5) / n
        bounds = self.bounds.to("cpu")
        centers, near = bounds.to_world(unit), self.bounds.near or 0.0
        count = torch.zeros(len(cells), dtype=torch.int32)
        required = min(min_cameras, len(camera_indices))
        for camera in camera_indices:
            candidates = (count < required).nonzero()[:, 0]  # skip cells that already have enough views
            points, view = centers[candidates], cameras[camera : camera + 1].to("cpu")
            count[candidates] += (view.project(points, 0)[2] & ((points - view.centers).norm(dim=1) > near)).int()
        in_view = count >= required
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
        """Updates every cell, or a quarter of them, with the optical depth at a random position.

        Args:
            number: number of the update.
            optical_depth: optical depth of a step at world positions.
            all_cells: update every cell.
            generator: generator of the positions.
        """
        n, total = self.resolution, self.resolution**3
        cells = torch.arange(0, total, 1 if all_cells else 4, device=self.device)
        if not all_cells:  # every fourth cell from a random start
            cells = cells + torch.randint(4, (1,), generator=generator, device=self.device)
            cells = torch.where(cells < total, cells, cells - total)
        index = cells.int() if total < 1 << 31 else cells  # 32-bit division is much faster
        row = index // n
        plane = row // n
        corner = torch.stack([plane, row - plane * n, index - row * n])
        unit = ((corner + r3_sequence(index, generator)) / n).T
        depths = optical_depth(self.bounds.to_world(unit))
        self.optical_depth[cells] = torch.maximum(self.optical_depth[cells] * self.decay, depths)
        occupied = self.in_view & (self.optical_depth > self.optical_depth.mean().mul(0.5).clamp_max(self.threshold))
        # An empty grid would give no samples and no gradient: start over with all cells.
        self.occupied = torch.where(occupied.any(), occupied, self.in_view)
        self.active = self.occupied & (self.last_visible >= number - self.visibility_window)

    @torch.no_grad()
    def resize(self, resolution: int) -> None:
        """Resizes the grid; each new cell takes the maximum of the old cells that it overlaps."""
        old, self.resolution = self.resolution, resolution
        edges = torch.arange(resolution + 1, device=self.device) * old
        first, last = edges[:-1] // resolution, (edges[1:] - 1) // resolution
        for name, cells in list(self.named_buffers()):
            grid = cells.view(old, old, old)
            for axis in range(3):
                grid = torch.maximum(grid.index_select(axis, first), grid.index_select(axis, last))
            setattr(self, name, grid.flatten())

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        """Resizes to the resolution of the loaded state, which may come from another growth stage."""
        cells = state_dict.get(f"{prefix}occupied", self.occupied).numel()
        if (side := round(cells ** (1 / 3))) != self.resolution and side**3 == cells:
            self.resize(side)
        super()._load_from_state_dict(state_dict, prefix, *rest)
