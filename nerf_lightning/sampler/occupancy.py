"""Skip empty space: a coarse grid remembers where the field has density (Instant-NGP, appendix C)."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.options import Count
from nerf_lightning.sampler.samples import DensityFn, Sampler, Samples, pack

MAX_CANDIDATES = 1 << 20
"""Intervals looked at together: bounds the memory of one call, whatever the number of rays."""


def cell_index(unit: Float[Tensor, "*batch 3"], resolution: int) -> Int[Tensor, "*batch"]:
    """Flat index of the cell of a resolution^3 grid over [0, 1]^3 that holds each position (clamped into the grid)."""
    x, y, z = (unit * resolution).long().clamp_(0, resolution - 1).unbind(-1)
    return (x * resolution + y) * resolution + z


class OccupancySampler(Sampler):
    """Steps of one length through the bounds, kept only in cells where density was found.

    Each cell holds a decaying maximum of the optical thickness (density times step) seen in it at random places; a cell is
    occupied while that stands above the lower of `threshold` and half the grid's mean.

    Args:
        bounds: where the content is.
        samples: steps along the diagonal of the bounds; rays that cross less of it get fewer.
        resolution: cells along each side.
        threshold: optical thickness of a step above which a cell counts as occupied.
        decay: factor on a cell's memory at each update.
        update_every: training steps between updates.
        warmup: steps during which every update looks at every cell; afterwards at a quarter of them.
    """

    thickness: Tensor
    occupied: Tensor

    def __init__(
        self,
        bounds: Bounds,
        samples: Count = 256,
        resolution: Count = 64,
        threshold: float = 0.01,
        decay: float = 0.95,
        update_every: Count = 16,
        warmup: int = 256,
    ):
        super().__init__(bounds)
        self.samples = samples
        self.resolution = resolution
        self.threshold = threshold
        self.decay = decay
        self.update_every = update_every
        self.warmup = warmup
        self.register_buffer("thickness", torch.zeros(resolution**3))
        self.register_buffer("occupied", torch.ones(resolution**3, dtype=torch.bool))

    @property
    def step_length(self) -> float:
        """Length of one step inside the box, in world units."""
        return 2 * float(self.bounds.half_size.norm()) / self.samples

    def edges(self, rays: Rays, generator: Generator | None) -> tuple[Float[Tensor, "R S_plus_1"], Bool[Tensor, "R S"]]:
        """All candidate intervals of each ray, and which of them lie within the bounds."""
        near, far = self.bounds.near_far(rays)
        # One more than the steps: the first one may be cut short by the shift, and the last must reach the far end.
        steps = torch.arange(self.samples + 2, device=near.device)
        shift = torch.zeros_like(near)
        if generator is not None:
            shift = torch.rand(near.shape, generator=generator, device=near.device)
        if self.bounds.unbounded:
            s = ((steps + shift[:, None] - 0.5) / self.samples).clamp(0, 1)
            edges = self.bounds.distances(near, far, s)
        else:
            edges = near[:, None] + (steps + shift[:, None] - 0.5).clamp_min(0) * self.step_length
            edges = torch.minimum(edges, far[:, None])
        return edges, edges[:, 1:] > edges[:, :-1]

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        edges, keep = self.edges(rays, generator)
        rows = max(1, MAX_CANDIDATES // self.samples)
        for start in range(0, len(rays), rows):
            part = slice(start, start + rows)
            inside = keep[part]
            ray, column = inside.nonzero(as_tuple=True)
            t = (edges[part][ray, column] + edges[part][ray, column + 1]) / 2
            chunk = rays[part]
            unit = self.bounds.to_unit(chunk.origins[ray] + t[:, None] * chunk.directions[ray])
            inside[ray, column] = self.occupied[cell_index(unit, self.resolution)]
        return pack(edges, keep)

    @torch.no_grad()
    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        if step % self.update_every:
            return
        device = self.thickness.device
        total = self.resolution**3
        if step < self.warmup:
            cells = torch.arange(total, device=device)
        else:
            # A random phase of a stride of four: no cell twice, and every cell has the same chance.
            phase = int(torch.randint(4, (), generator=generator, device=device))
            cells = torch.arange(phase, total, 4, device=device)
        n = self.resolution
        corner = torch.stack([cells // (n * n), cells // n % n, cells % n], dim=-1)
        unit = (corner + torch.rand(corner.shape, generator=generator, device=device)) / n
        seen = torch.cat([density(part) for part in self.bounds.to_world(unit).split(1 << 15)]) * self.step_length
        self.thickness[cells] = torch.maximum(self.thickness[cells] * self.decay, seen)
        occupied = self.thickness > min(self.threshold, 0.5 * float(self.thickness.mean()))
        # With no density anywhere there would be no samples, hence no gradient, for ever: look everywhere again.
        self.occupied = occupied if occupied.any() else torch.ones_like(occupied)
