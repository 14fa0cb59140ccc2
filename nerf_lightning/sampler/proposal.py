"""Proposals: a small field of density alone learns where the large one's samples are worth their time."""

from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import interval_midpoints, resample
from nerf_lightning.model.hashgrid import HashGrid, cubic_cells
from nerf_lightning.sampler.occupancy import OccupancySampler
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Histogram, Proposals, Sampler, Samples, interval_weights
from nerf_lightning.utils.option_checks import Count, GridSize, Gt, Layers, Le, Log2Size, Lt

INIT_LOG_DENSITY = -1.0
"""Logarithm of the density that proposals begin with, 1 / half-size: thin fog."""
ANNEAL_SLOPE = 10.0
"""How quickly proposals come to count in full."""


class ProposalSampler(Sampler):
    """As many samples on every ray, most of them where a small field expects surfaces.

    A ray is cut into even intervals (see `Bounds.s_to_t`), the small field gives each a weight, and new intervals of equal
    weight are cut; after the last cut they go to the large field. Its weights then teach the small one: wherever they are
    larger than proposed, the proposal grows (mip-NeRF 360, Barron et al. 2022, sections 3.1 and 3.2). The small field is a
    grid of logarithms of densities, on several levels that add up.

    Args:
        bounds: where the content is.
        samples: on each ray, for the large field.
        coarse_samples, fine_samples: intervals of the cuts before.
        anneal: steps until proposals count in full; before, samples are spread more evenly.
        histogram_padding: share of the samples that are spread evenly all the same.
        num_levels, base_resolution, max_resolution, log2_hashmap_size: of the small field, see `HashGridField`.
        lr_final_factor: what its learning rate falls to, besides the schedule. A small field that goes on learning
            quickly follows every flicker of the large one, which then has no samples where plain surfaces really are.
        chunk: see `Sampler`.
    """

    render_state = ("grid.tables",)

    def __init__(
        self,
        bounds: Bounds,
        samples: Count = 16,
        coarse_samples: Count = 48,
        fine_samples: Count = 24,
        anneal: int = 500,
        histogram_padding: Annotated[float, Gt(0), Lt(1)] = 0.01,
        num_levels: Layers = 2,
        base_resolution: GridSize = 32,
        max_resolution: GridSize = 128,
        log2_hashmap_size: Log2Size = 18,
        lr_final_factor: Annotated[float, Gt(0), Le(1)] = 0.02,  # at 0 it would learn nothing after the first step
        chunk: int = CHUNK,
    ):
        super().__init__(bounds, chunk)
        self.samples = samples
        self.coarse_samples, self.fine_samples = coarse_samples, fine_samples
        self.anneal = anneal
        self.histogram_padding = histogram_padding
        self.lr_final_factor = lr_final_factor
        self.grid = HashGrid(cubic_cells(num_levels, base_resolution, max_resolution), log2_hashmap_size, 1)
        self.unit_length = bounds.max_half_size
        self.first_step = 0
        """The step at which training began."""
        self.step = 0

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"name": "sampler", "params": list(self.parameters())}]

    def lr_factors(self, progress: float) -> dict[str, float]:
        return {"sampler": self.lr_final_factor**progress}

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        near, far = self.bounds.near_far(rays)
        count, device = len(rays), near.device
        s = torch.linspace(0, 1, self.coarse_samples + 1, device=device).expand(count, -1)
        if generator is not None:
            s = torch.cat(
                [s[:, :1], s[:, 1:-1] + self._jitter(rays, generator) / self.coarse_samples, s[:, -1:]], dim=1
            )
        histograms: list[Histogram] = []
        for wanted in (self.fine_samples, self.samples):
            with torch.set_grad_enabled(generator is not None):
                histograms.append(Histogram(s, self.weights(rays, near, far, s)))
            share = histograms[-1].weights.detach() + self.histogram_padding / s.shape[1]
            if generator is not None:
                share = share**self.anneal_exponent
            s = resample(s, share, self._jitter(rays, generator)[:, 0], wanted)
        _, t, dt = interval_midpoints(rays, self.bounds, near, far, s)
        ray = torch.arange(count, device=device).repeat_interleave(self.samples)
        offsets = torch.arange(count + 1, device=device) * self.samples
        proposals = None if generator is None else Proposals(tuple(histograms), s)
        return Samples(t.flatten(), dt.flatten(), ray, offsets, proposals=proposals)

    def _jitter(self, rays: Rays, generator: Generator | None) -> Float[Tensor, "R 1"]:
        """By how much of an interval edges move, in -1/2 ... 1/2; not at all without a generator."""
        if generator is None:
            return torch.zeros(len(rays), 1, device=rays.origins.device)
        return torch.rand(len(rays), 1, generator=generator, device=rays.origins.device) - 0.5

    @property
    def anneal_exponent(self) -> float:
        """The power of the proposals: 0 spreads samples evenly, 1 follows them (mip-NeRF 360, section 3.2)."""
        share = min(1.0, (self.step - self.first_step + 1) / max(self.anneal, 1))
        return ANNEAL_SLOPE * share / ((ANNEAL_SLOPE - 1) * share + 1)

    def weights(
        self, rays: Rays, near: Float[Tensor, "R"], far: Float[Tensor, "R"], s: Float[Tensor, "R S_plus_1"]
    ) -> Float[Tensor, "R S"]:
        """How much the small field thinks that each interval contributes to its ray's pixel, see `volume_weights`."""
        unit, t, dt = interval_midpoints(rays, self.bounds, near, far, s)
        density = torch.exp(self.grid(unit).sum(1) + INIT_LOG_DENSITY)
        return interval_weights(density.view(t.shape) * (dt / self.unit_length))

    def losses(self, samples: Samples, weights: Float[Tensor, "N"] | None) -> dict[str, Float[Tensor, ""]]:
        if samples.proposals is None or weights is None:
            return {}
        histograms, edges = samples.proposals
        found = weights.detach().view(len(edges), -1)
        terms = [interlevel_loss(edges, found, histogram) for histogram in histograms]
        return {"interlevel": torch.stack(terms).sum()}

    @torch.no_grad()
    def restart(self, step: int) -> None:
        self.first_step = step
        self.grid.tables.zero_()

    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        self.step = step


def interlevel_loss(
    edges: Float[Tensor, "R K_plus_1"], weights: Float[Tensor, "R K"], proposed: Histogram
) -> Float[Tensor, ""]:
    """How much weight was found where less was proposed: mip-NeRF 360, eq. 12 and 13, a mean over rays.

    Args:
        edges, weights: of the intervals of the large field.
        proposed: of the small one, with gradient.
    """
    last = proposed.weights.shape[1]
    sums = torch.nn.functional.pad(proposed.weights.cumsum(1), (1, 0))
    before = proposed.edges.contiguous()
    low = (torch.searchsorted(before, edges[:, :-1].contiguous(), right=True) - 1).clamp(0, last)
    high = torch.searchsorted(before, edges[:, 1:].contiguous()).clamp(0, last)
    bound = sums.gather(1, high) - sums.gather(1, low)
    return ((weights - bound).clamp_min(0) ** 2 / (weights + 1e-5)).sum(1).mean()


def choose_sampler(bounds: Bounds, chunk: int = CHUNK) -> Sampler:
    """Proposals where every ray meets something, as before a background; where most of the space is empty, an occupancy grid,
    which skips it."""
    return ProposalSampler(bounds, chunk=chunk) if bounds.unbounded else OccupancySampler(bounds, chunk=chunk)
