"""Skip empty space: a coarse grid remembers where the field has density (Instant-NGP, appendix C)."""

import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import keep_visible, march
from nerf_lightning.options import Count
from nerf_lightning.sampler.samples import DensityFn, Sampler, Samples

MAX_ASKED = 1 << 17
"""Positions at which the density is asked together: bounds the memory of one call."""


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
        transparent: transmittance below which a ray has ended: what lies behind is dropped.
        thin: opacity of a step below which it is dropped.
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
        transparent: float = 1e-4,
        thin: float = 1e-3,
    ):
        super().__init__(bounds)
        self.samples = samples
        self.resolution = resolution
        self.threshold = threshold
        self.decay = decay
        self.update_every = update_every
        self.warmup = warmup
        self.transparent = transparent
        self.thin = thin
        self.register_buffer("thickness", torch.zeros(resolution**3))
        self.register_buffer("occupied", torch.ones(resolution**3, dtype=torch.bool))

    @property
    def step_length(self) -> float:
        """Length of one step inside the box, in world units."""
        return 2 * float(self.bounds.half_size.norm()) / self.samples

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        near, far = self.bounds.near_far(rays)
        shift = torch.zeros_like(near)
        if generator is not None:
            shift = torch.rand(near.shape, generator=generator, device=near.device)
        packed = march(rays, self.bounds, near, far, shift, self.occupied, self.samples, self.step_length)
        with torch.no_grad():
            seen = torch.cat([density(part) for part in Samples(*packed).positions(rays).split(MAX_ASKED)])
        return Samples(*keep_visible(seen, packed, self.transparent, self.thin))

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
