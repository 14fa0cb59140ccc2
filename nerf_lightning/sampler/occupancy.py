"""Skip empty space: a coarse grid remembers where the field has density (Instant-NGP, appendix C)."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import keep_visible, march, mark_cells
from nerf_lightning.kernels.march import Packed
from nerf_lightning.sampler.samples import DensityFn, Sampler, Samples
from nerf_lightning.utils.options import Count

ASKED, LOOKED_AT = 4, 32
"""Positions at which the density is asked together, and steps looked at together, for each sample that is rendered so."""
MOST_CAMERAS = 128
"""Cameras, evenly chosen, that tell which cells are in view."""
ROOM = 1.25
"""Times as many steps as were last counted there is room for, where they are not counted."""


def in_view(camera: Cameras, points: Float[Tensor, "N 3"], near: float) -> Bool[Tensor, "N"]:
    """Which points of the world one camera has in its picture, farther from it than `near`."""
    rotation, eye = camera.c2w[0, :3, :3], camera.c2w[0, :3, 3]
    local = (points - eye) @ rotation
    pixels = local @ camera.K[0].T
    size = torch.tensor([camera.width, camera.height])
    inside = ((pixels[:, :2] > 0) & (pixels[:, :2] < size * pixels[:, 2:])).all(1)
    return inside & (local[:, 2] > 0) & (local.norm(dim=1) > near)


class OccupancySampler(Sampler):
    """Steps of one length through the bounds, kept only where there is something that light can reach.

    A coarse grid says where to look. Each cell holds a decaying maximum of the optical thickness (density times step) found
    in it at random places; it is occupied while that stands above the lower of `threshold` and half the grid's mean. In
    training, only cells that light reached lately are looked at, but for one step in `update_every` that looks at all
    occupied ones: what lies inside a solid costs nothing. Then the field's density is asked along the steps found, and those
    behind something opaque, and those that hold nothing, are dropped.

    Args:
        bounds: where the content is.
        samples: steps along the diagonal of the bounds; rays that cross less of it get fewer.
        resolution: cells along each side.
        threshold: optical thickness of a step above which a cell counts as occupied.
        decay: factor on a cell's memory each time it is looked at.
        update_every: training steps between updates.
        warmup: steps during which every update looks at every cell; afterwards at a quarter of them.
        memory: updates after which a cell that light no longer reached is left out.
        seen_by: cells that fewer training cameras have in view are left empty: what one camera alone sees can be anything, such
            as fog before its lens.
        transparent: transmittance below which a ray has ended, above 0.
        thin: opacity of a step below which training drops it; never more than half the mean, so that a fog trains too.
    """

    thickness: Tensor
    occupied: Tensor
    allowed: Tensor
    reached: Tensor
    lit: Tensor

    def __init__(
        self,
        bounds: Bounds,
        samples: Count = 192,
        resolution: Count = 64,
        threshold: float = 0.01,
        decay: float = 0.8,
        update_every: Count = 16,
        warmup: int = 256,
        memory: Count = 8,
        seen_by: int = 3,
        transparent: float = 1e-4,
        thin: float = 5e-3,
    ):
        super().__init__(bounds)
        if not 0 < transparent < 1:
            raise InputError("sampler.transparent", "", str(transparent), "between 0 and 1")
        if not 0 <= thin < 1:
            raise InputError("sampler.thin", "", str(thin), "at least 0, below 1")
        self.samples = samples
        self.resolution = resolution
        self.threshold = threshold
        self.decay = decay
        self.update_every = update_every
        self.warmup = warmup
        self.memory = memory
        self.seen_by = seen_by
        self.transparent = transparent
        self.thin = thin
        cells = resolution**3
        self.register_buffer("thickness", torch.zeros(cells))
        self.register_buffer("occupied", torch.ones(cells, dtype=torch.bool))
        self.register_buffer("allowed", torch.ones(cells, dtype=torch.bool))
        self.register_buffer("reached", torch.zeros(cells, dtype=torch.int32))
        self.register_buffer("lit", torch.ones(cells, dtype=torch.bool))
        self.first_step = 0
        """Where training began: the warm-up counts from there."""
        self.updates = 0
        """Number of the last update; `reached` holds the number of the update after which light last met the cell."""
        self.look_everywhere = True
        """Whether the next training step looks at all occupied cells."""
        self.per_ray: tuple[float, float] | None = None
        """Steps a ray in occupied cells, and those of them that were kept, when they were last counted; None where the next
        training step is to count. To count is to wait for the device: but on a CPU, where that costs nothing, the steps
        between two updates take it that there will be as many."""
        self.step_length = 2 * float(bounds.half_size.norm()) / samples
        """Length of one step inside the box, in world units."""

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        near, far = self.bounds.near_far(rays)
        if generator is None:
            packed = self._march(rays, near, far, torch.zeros_like(near), self.occupied)
            # A picture must not depend on how its rays are cut into calls: only training looks at the mean, and drops.
            return Samples(*keep_visible(self._thickness(density, rays, packed), packed, self.transparent, 0.0))
        shift = torch.rand(near.shape, generator=generator, device=near.device)
        cells = self.occupied if self.look_everywhere else self.lit
        rooms = [None, None] if self.per_ray is None else [math.ceil(ROOM * many * len(rays)) for many in self.per_ray]
        packed = self._march(rays, near, far, shift, cells, rooms[0])
        found = self._thickness(density, rays, packed)
        thin = found.mean().mul(0.5).clamp_max(-math.log1p(-self.thin)) if len(found) else 0.0
        kept = keep_visible(found, packed, self.transparent, thin, rooms[1])
        places = Samples(*kept).positions(rays)
        mark_cells(self.reached, self.updates, self.bounds, places)
        if rooms[0] is not None:
            whole = (packed[3][1:] <= rooms[0]) & (kept[3][1:] <= rooms[1])
            return Samples(*kept, whole, places)
        if rays.origins.device.type != "cpu":
            self.per_ray = max(len(found), 1) / len(rays), max(len(kept[0]), 1) / len(rays)
        return Samples(*kept, places=places)

    def _march(
        self,
        rays: Rays,
        near: Float[Tensor, "R"],
        far: Float[Tensor, "R"],
        shift: Float[Tensor, "R"],
        cells: Bool[Tensor, "cells"],
        room: int | None = None,
    ) -> Packed:
        return march(
            rays, self.bounds, near, far, shift, cells, self.samples, self.step_length, room, LOOKED_AT * self.chunk
        )

    @torch.no_grad()
    def _thickness(self, density: DensityFn, rays: Rays, packed: Packed) -> Float[Tensor, "N"]:
        """Optical thickness of intervals, by the density at their middle; mixed precision gives halves."""
        found = [density(part).float() for part in Samples(*packed).positions(rays).split(ASKED * self.chunk)]
        return (found[0].detach() if len(found) == 1 else torch.cat(found)) * packed[1]

    @torch.no_grad()
    def look_through(self, cameras: Cameras) -> None:
        """Leaves cells empty for good whose middle fewer than `seen_by` cameras have in view."""
        chosen = torch.linspace(0, len(cameras) - 1, min(len(cameras), MOST_CAMERAS)).round().long()
        n = self.resolution
        cells = torch.arange(n**3)
        unit = (torch.stack([cells // (n * n), cells // n % n, cells % n], dim=1) + 0.5) / n
        bounds = self.bounds.to("cpu")
        centres, near = bounds.to_world(unit), self.bounds.near or 0.0
        count = torch.zeros(len(cells), dtype=torch.int32)
        wanted = min(self.seen_by, len(chosen))
        for camera in chosen:
            open_ones = (count < wanted).nonzero()[:, 0]  # what is in view often enough needs no more looks
            count[open_ones] += in_view(cameras[camera : camera + 1].to("cpu"), centres[open_ones], near).int()
        allowed = count >= wanted
        self.allowed.copy_(allowed if allowed.any() else torch.ones_like(allowed))
        self.occupied &= self.allowed
        self.lit &= self.allowed

    def packed(self) -> dict[str, Tensor]:
        return {"occupied": self.occupied}

    def unpack(self, packed: dict[str, Tensor]) -> None:
        if packed["occupied"].shape != self.occupied.shape:
            raise RuntimeError(f"an occupancy grid of {len(packed['occupied'])} cells, not {len(self.occupied)}")
        self.occupied.copy_(packed["occupied"])

    def restart(self, step: int) -> None:
        self.first_step = step
        self.per_ray = None

    @torch.no_grad()
    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        self.updates, phase = divmod(step, self.update_every)
        self.look_everywhere = not phase
        if phase <= 1:  # other cells than in the step before
            self.per_ray = None
        if phase:
            return
        device = self.thickness.device
        total = self.resolution**3
        if step - self.first_step < self.warmup:
            cells = torch.arange(total, device=device)
        else:
            # A random phase of a stride of four: no cell twice, and every cell has the same chance.
            start = torch.randint(4, (1,), generator=generator, device=device)
            cells = (torch.arange(0, total, 4, device=device) + start) % total
        n = self.resolution
        corner = torch.stack([cells // (n * n), cells // n % n, cells % n])
        unit = ((corner + torch.rand(corner.shape, generator=generator, device=device)) / n).T
        found = (
            torch.cat([density(part) for part in self.bounds.to_world(unit).split(ASKED * self.chunk)])
            * self.step_length
        )
        self.thickness[cells] = torch.maximum(self.thickness[cells] * self.decay, found)
        occupied = self.allowed & (self.thickness > self.thickness.mean().mul(0.5).clamp_max(self.threshold))
        # With no density anywhere there would be no samples, hence no gradient, for ever: look everywhere again.
        self.occupied = torch.where(occupied.any(), occupied, self.allowed)
        self.lit = self.occupied & (self.reached >= self.updates - self.memory)
