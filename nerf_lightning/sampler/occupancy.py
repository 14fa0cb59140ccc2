"""Skip empty space: a coarse grid remembers where the field has density (Instant-NGP, appendix C)."""

import math
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import front_first, keep_visible, mark_cells
from nerf_lightning.kernels.march import BLOCK, Packed
from nerf_lightning.sampler.samples import DensityFn, Sampler, Samples
from nerf_lightning.utils.options import Count, Side

RESOLUTION = 64
"""Cells along a side for a field of usual size."""
STEPS, PICTURE_STEPS = 3, 4
"""Steps along the diagonal for each of them, in training, where they begin elsewhere each time, and in pictures: on Lego at 200
and 800 pixels the finer ones add 0.3 dB to a picture, and a sixth to its time."""
ASKED, LOOKED_AT = 4, 32
"""How many positions are evaluated at a time, and how many steps are tested at a time, as multiples of `Sampler.chunk`."""
MOST_CAMERAS = 128
"""Most cameras, evenly chosen, that decide which cells are in view."""
UNSEEN = 0.5 / 255
"""Optical thickness that rays of a picture may lose to steps that hold less, and transmittance at which they end: half of
what 8 bits tell."""
ROOM = 1.25
"""Room for steps that are not counted, as a multiple of the last count."""

FINE = 1 << 24
"""Places along an axis of a cell: as many as single precision tells apart."""
PLASTIC = 1.2207440846057596
"""The root above 1 of x^4 = x + 1."""


def in_view(camera: Cameras, points: Float[Tensor, "N 3"], near: float) -> Bool[Tensor, "N"]:
    """Which world points one camera sees, farther from it than `near`."""
    return camera.project(points, 0)[2] & ((points - camera.centres).norm(dim=1) > near)


def spread_evenly(numbers: Int[Tensor, "N"], generator: Generator) -> Float[Tensor, "3 N"]:
    """A place in [0, 1)^3 for each whole number: a lattice of irrational steps, moved at random as a whole (the additive
    recurrence R3; Roberts 2018). For a million cells this takes a fraction of the time of as many random numbers."""
    device = numbers.device
    steps = torch.tensor([[round(FINE / PLASTIC**power)] for power in (1, 2, 3)], dtype=torch.int32, device=device)
    start = torch.randint(FINE, (3, 1), generator=generator, device=device, dtype=torch.int32)
    return ((numbers * steps + start) & (FINE - 1)) / FINE  # what overflows is beyond the bits that count


class OccupancySampler(Sampler):
    """Steps of one length through the bounds, kept only where there is something that light can reach.

    A coarse grid says where to look. Each cell holds a decaying maximum of the optical thickness (density times step) found
    at random positions in it; it is occupied while that is above the lower of `threshold` and half the grid's mean. Training
    looks only at cells that light reached lately, except that every `update_every`-th step looks at all occupied ones: the
    inside of a solid costs nothing. The field's density is then evaluated along these steps, and those behind something
    opaque and those that hold nothing are dropped.

    Args:
        bounds: where the content is.
        samples: steps along the diagonal of the bounds; rays that cross less of it get fewer. None: three times `resolution`,
            in pictures four times.
        resolution: cells along each side. None: 64, and more where the field becomes finer than usual, see `refine`.
        threshold: optical thickness of a step above which a cell counts as occupied.
        decay: factor on a cell's maximum at each update.
        update_every: training steps between updates.
        warmup: steps during which updates cover every cell; afterwards each covers a quarter of them.
        memory: updates after which a cell that light no longer reaches is skipped.
        seen_by: cells seen by fewer training cameras stay empty: what only one camera sees can be anything, such as fog in
            front of its lens.
        early_stop_eps: early-stop transmittance, above 0: below it a ray has ended; in pictures at 1/510 at the latest.
        alpha_thre: alpha threshold: training drops steps of lower opacity; at most half the mean, so that fog trains too.
    """

    thickness: Tensor
    occupied: Tensor
    allowed: Tensor
    reached: Tensor
    lit: Tensor

    def __init__(
        self,
        bounds: Bounds,
        samples: Count | None = None,
        resolution: Side | None = None,
        threshold: float = 0.01,
        decay: float = 0.8,
        update_every: Count = 16,
        warmup: int = 256,
        memory: Count = 8,
        seen_by: int = 3,
        early_stop_eps: float = 1e-4,
        alpha_thre: float = 5e-3,
    ):
        super().__init__(bounds)
        if not 0 < early_stop_eps < 1:
            raise InputError("sampler.early_stop_eps", "", str(early_stop_eps), "between 0 and 1")
        if not 0 <= alpha_thre < 1:
            raise InputError("sampler.alpha_thre", "", str(alpha_thre), "at least 0, below 1")
        self.stated = samples, resolution
        self.diagonal = 2 * float(self.bounds.half_size.norm())  # a number: reading it from a device would wait
        self.set_resolution(resolution or RESOLUTION)
        self.threshold = threshold
        self.decay = decay
        self.update_every = update_every
        self.warmup = warmup
        self.memory = memory
        self.seen_by = seen_by
        self.early_stop_eps = early_stop_eps
        self.alpha_thre = alpha_thre
        cells = self.resolution**3
        self.register_buffer("thickness", torch.zeros(cells))
        self.register_buffer("occupied", torch.ones(cells, dtype=torch.bool))
        self.register_buffer("allowed", torch.ones(cells, dtype=torch.bool))
        self.register_buffer("reached", torch.zeros(cells, dtype=torch.int32))
        self.register_buffer("lit", torch.ones(cells, dtype=torch.bool))
        self.first_step = 0
        """The step at which training began; the warm-up counts from it."""
        self.updates = 0
        """Number of the last update; `reached` holds, for each cell, the number of the last update before light last met it."""
        self.look_everywhere = True
        """Whether the next training step looks at all occupied cells."""
        self.thin: Tensor | None = None
        """Optical thickness below which training drops steps; None where the cells have changed since it was computed."""
        self.per_ray: tuple[float, float] | None = None
        """Steps per ray in occupied cells, and how many of those were kept, at the last count; None if the next training step
        must count. Counting waits for the device, so except on a CPU the steps between two updates assume the last count."""

    @property
    def rays_at_once(self) -> int:
        """On a CPU more than elsewhere: it goes some steps at a time along rays, front first."""
        return max(1, self.chunk // 2) if self.thickness.device.type == "cpu" else super().rays_at_once

    def set_resolution(self, cells: int) -> None:
        """Takes so many cells along each side, and steps to match; buffers stay."""
        self.resolution = cells
        self.samples, self.picture_samples = (self.stated[0] or steps * cells for steps in (STEPS, PICTURE_STEPS))

    def length(self, samples: int) -> float:
        """Of one of so many steps, inside the box, in world units."""
        return self.diagonal / samples

    @torch.no_grad()
    def refine(self, finer: float) -> None:
        old, new = self.resolution, BLOCK * round(RESOLUTION / BLOCK * finer)
        if self.stated[1] is not None or new == old:
            return
        # A cell holds whatever the cells that it lies in held.
        edges = torch.arange(new + 1, device=self.thickness.device) * old
        first, last = edges[:-1] // new, (edges[1:] - 1) // new
        before = self.samples
        self.set_resolution(new)
        for name in ("thickness", "occupied", "allowed", "reached", "lit"):
            grid = getattr(self, name).view(old, old, old)
            for axis in range(3):
                grid = torch.maximum(grid.index_select(axis, first), grid.index_select(axis, last))
            setattr(self, name, grid.flatten())
        self.thickness *= before / self.samples
        self.per_ray = self.thin = None

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        near, far = self.bounds.near_far(rays)
        if generator is None:
            steps, stop = self.picture_samples, max(self.early_stop_eps, UNSEEN)
            found, packed = self._look(rays, density, near, far, torch.zeros_like(near), self.occupied, steps, stop)
            # A picture must not depend on how its rays are split into calls: only training uses the mean to drop steps.
            found, packed = keep_visible(found, packed, stop, UNSEEN, dropped=UNSEEN)
            return Samples(*packed, thickness=found)
        shift = torch.rand(near.shape, generator=generator, device=near.device)
        cells = self.occupied if self.look_everywhere else self.lit
        rooms = [None, None] if self.per_ray is None else [math.ceil(ROOM * many * len(rays)) for many in self.per_ray]
        found, packed = self._look(rays, density, near, far, shift, cells, self.samples, self.early_stop_eps, rooms[0])
        if self.thin is None:
            mean = (self.thickness * self.lit).sum() / self.lit.sum()
            self.thin = mean.mul(0.5).clamp_max(-math.log1p(-self.alpha_thre))
        _, kept = keep_visible(found, packed, self.early_stop_eps, self.thin, rooms[1])
        places = Samples(*kept).positions(rays)
        mark_cells(self.reached, self.updates, self.bounds, places)
        if rooms[0] is not None:
            whole = (packed[3][1:] <= rooms[0]) & (kept[3][1:] <= rooms[1])
            return Samples(*kept, whole, places)
        if rays.origins.device.type != "cpu":
            self.per_ray = max(len(found), 1) / len(rays), max(len(kept[0]), 1) / len(rays)
        return Samples(*kept, places=places)

    @torch.no_grad()
    def _look(
        self,
        rays: Rays,
        density: DensityFn,
        near: Float[Tensor, "R"],
        far: Float[Tensor, "R"],
        shift: Float[Tensor, "R"],
        cells: Bool[Tensor, "cells"],
        samples: int,
        stop: float,
        room: int | None = None,
    ) -> tuple[Float[Tensor, "N"], Packed]:
        """Steps in some cells and the optical thickness of each, as far as light reaches."""

        def thickness(packed: Packed) -> Float[Tensor, "N"]:
            """From the density at the steps' middle, which mixed precision gives in half precision."""
            found = [density(part).float() for part in Samples(*packed).positions(rays).split(ASKED * self.chunk)]
            return (found[0].detach() if len(found) == 1 else torch.cat(found)) * packed[1]

        given = rays, self.bounds, near, far, shift, cells, samples, self.length(samples)
        return front_first(*given, thickness, stop, room, LOOKED_AT * self.chunk)

    @torch.no_grad()
    def look_through(self, cameras: Cameras) -> None:
        """Empties for good the cells whose middle fewer than `seen_by` cameras see."""
        chosen = torch.linspace(0, len(cameras) - 1, min(len(cameras), MOST_CAMERAS)).round().long()
        n = self.resolution
        cells = torch.arange(n**3)
        unit = (torch.stack([cells // (n * n), cells // n % n, cells % n], dim=1) + 0.5) / n
        bounds = self.bounds.to("cpu")
        centres, near = bounds.to_world(unit), self.bounds.near or 0.0
        count = torch.zeros(len(cells), dtype=torch.int32)
        wanted = min(self.seen_by, len(chosen))
        for camera in chosen:
            open_ones = (count < wanted).nonzero()[:, 0]  # the others have enough views already
            count[open_ones] += in_view(cameras[camera : camera + 1].to("cpu"), centres[open_ones], near).int()
        allowed = count >= wanted
        self.allowed.copy_(allowed if allowed.any() else torch.ones_like(allowed))
        self.occupied &= self.allowed
        self.lit &= self.allowed

    def export_state(self) -> dict[str, Tensor]:
        return {"occupied": self.occupied}

    def import_state(self, state: dict[str, Tensor]) -> None:
        self._take_size(state["occupied"])
        if state["occupied"].shape != self.occupied.shape:
            raise RuntimeError(f"an occupancy grid of {len(state['occupied'])} cells, not {len(self.occupied)}")
        self.occupied.copy_(state["occupied"])

    def _take_size(self, cells: Tensor) -> None:
        """Makes room for the cells of another stage of training."""
        side = round(cells.numel() ** (1 / 3))
        if self.stated[1] is None and cells.shape == (side**3,) and side % BLOCK == 0:
            self.refine(side / RESOLUTION)

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        occupied = state_dict.get(f"{prefix}occupied")
        if occupied is not None:
            self._take_size(occupied)
        self.thin = None
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def restart(self, step: int) -> None:
        self.first_step = step
        self.per_ray = None

    @torch.no_grad()
    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        self.updates, phase = divmod(step, self.update_every)
        self.look_everywhere = not phase
        if phase <= 1:  # the cells differ from those of the step before
            self.per_ray = None
        if phase:
            return
        device = self.thickness.device
        total = self.resolution**3
        if step - self.first_step < self.warmup:
            cells = torch.arange(total, device=device)
        else:
            # Every fourth cell from a random start: no cell twice, all equally likely.
            start = torch.randint(4, (1,), generator=generator, device=device)
            cells = torch.arange(0, total, 4, device=device) + start
            cells = torch.where(cells < total, cells, cells - total)
        n = self.resolution
        number = cells.int() if total < 1 << 31 else cells  # 32 bits are divided in a fraction of the time
        row = number // n
        plane = row // n
        corner = torch.stack([plane, row - plane * n, number - row * n])
        unit = ((corner + spread_evenly(number, generator)) / n).T
        found = torch.cat(
            [density(part) for part in self.bounds.to_world(unit).split(ASKED * self.chunk)]
        ) * self.length(self.samples)
        self.thickness[cells] = torch.maximum(self.thickness[cells] * self.decay, found)
        occupied = self.allowed & (self.thickness > self.thickness.mean().mul(0.5).clamp_max(self.threshold))
        # Without any density there would be no samples, so no gradient, forever: look everywhere again.
        self.occupied = torch.where(occupied.any(), occupied, self.allowed)
        self.lit = self.occupied & (self.reached >= self.updates - self.memory)
        self.thin = None
