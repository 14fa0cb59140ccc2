"""Proposal network sampling (mip-NeRF 360): a small density field predicts where to sample the main field."""

import functools
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import interlevel_loss, interval_midpoints, proposal_weights, resample
from nerf_lightning.kernels.cached_constants import cache_constants
from nerf_lightning.model.hashgrid import HashGrid, cubic_cells
from nerf_lightning.sampler.occupancy import OccupancySampler
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Histogram, Proposals, Sampler, Samples
from nerf_lightning.utils.option_checks import Count, GridSize, Gt, Layers, Le, Log2Size, Lt

EVAL_SAMPLES_FACTOR = 1.25
"""Samples per ray in evaluation, where nothing averages over jitter, relative to training. On captures it gains 0.1 to
0.2 dB and costs a fifth more render time."""
INIT_LOG_DENSITY = -1.0
"""Initial log-density of the proposal field, 1 / half-size: thin fog."""
ANNEAL_SLOPE = 10.0
"""Slope of the annealing bias curve (mip-NeRF 360, section 3.2)."""


@cache_constants
def _make_even_edges(
    intervals: int, device: torch.device
) -> tuple[Float[Tensor, "S_plus_1"], Float[Tensor, "S_plus_1"]]:
    """Even edges in [0, 1], and the divisors of a shift in intervals, infinite at both ends."""
    divisors = torch.full((intervals + 1,), float(intervals))
    divisors[0] = divisors[-1] = torch.inf
    return torch.linspace(0, 1, intervals + 1, device=device), divisors.to(device)


class ProposalSampler(Sampler):
    """A fixed number of samples per ray, drawn from the proposal field's weights.

    Intervals are even in s (see `Bounds.s_to_t`), then resampled twice by the proposal field's weights. The interlevel loss
    trains the proposals to bound the main field's weights (mip-NeRF 360, Barron et al. 2022, sections 3.1 and 3.2). The
    proposal field is a hash grid whose levels sum to a log-density.

    Args:
        bounds: the box of the content.
        samples: samples per ray for the main field in training; `EVAL_SAMPLES_FACTOR` times as many in evaluation.
        coarse_samples, fine_samples: intervals of the two proposal passes.
        anneal: steps until the proposals apply in full; before, samples are spread more evenly.
        histogram_padding: fraction of the samples that stays evenly spread.
        num_levels, base_resolution, max_resolution, log2_hashmap_size: options of the hash grid, see `HashGridField`.
        lr_final_factor: final learning-rate factor of the proposal field, on top of the schedule. If it keeps learning fast
            it follows noise in the main field, which then gets no samples on textureless surfaces.
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
        lr_final_factor: Annotated[float, Gt(0), Le(1)] = 0.02,  # 0 would stop it after the first step
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
        """First training step; annealing counts from it."""
        self.step = 0

    @property
    def ray_chunk_size(self) -> int:
        """Rays sampled together; more on a CPU, which loads each level's table into its cache less often."""
        return max(1, self.chunk // 4) if self.grid.tables.device.type == "cpu" else super().ray_chunk_size

    def param_groups(self) -> list[dict[str, Any]]:
        return [{"name": "sampler", "params": list(self.parameters())}]

    def lr_factors(self, progress: float) -> dict[str, float]:
        return {"sampler": self.lr_final_factor**progress}

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        near, far = self.bounds.near_far(rays)
        count, device = len(rays), near.device
        if generator is None:
            shifts = torch.zeros(3, count, device=device).unbind()
        else:  # in intervals, uniform in [-1/2, 1/2); new tensors, as kernels are compiled for their alignment
            uniform = torch.rand(3, count, generator=generator, device=device)
            shifts = torch._foreach_sub(uniform.unbind(), 0.5)
        even, divisors = _make_even_edges(self.coarse_samples, device)
        s = torch.addcdiv(even, shifts[0][:, None], divisors)
        histograms: list[Histogram] = []
        per_ray = self.samples if generator is not None else round(EVAL_SAMPLES_FACTOR * self.samples)
        for num_samples, shift in ((self.fine_samples, shifts[1]), (per_ray, shifts[2])):
            with torch.set_grad_enabled(generator is not None):
                histograms.append(Histogram(s, self.weights(rays, near, far, s)))
            pdf = histograms[-1].weights.detach() + self.histogram_padding / s.shape[1]
            if generator is not None:
                pdf = pdf**self.anneal_exponent
            s = resample(s, pdf, shift, num_samples)
        _, t, dt = interval_midpoints(rays, self.bounds, near, far, s)
        ray = torch.arange(count, device=device).repeat_interleave(per_ray)
        offsets = torch.arange(count + 1, device=device) * per_ray
        proposals = None if generator is None else Proposals(tuple(histograms), s)
        return Samples(t.flatten(), dt.flatten(), ray, offsets, proposals=proposals)

    @property
    def anneal_exponent(self) -> float:
        """Exponent of the proposal weights: 0 spreads samples evenly, 1 follows them (mip-NeRF 360, section 3.2)."""
        progress = min(1.0, (self.step - self.first_step + 1) / max(self.anneal, 1))
        return ANNEAL_SLOPE * progress / ((ANNEAL_SLOPE - 1) * progress + 1)

    def weights(
        self, rays: Rays, near: Float[Tensor, "R"], far: Float[Tensor, "R"], s: Float[Tensor, "R S_plus_1"]
    ) -> Float[Tensor, "R S"]:
        """Rendering weights of the proposal field, see `volume_weights`."""
        unit, _, dt = interval_midpoints(rays, self.bounds, near, far, s)
        return proposal_weights(self.grid(unit), dt, INIT_LOG_DENSITY, self.unit_length)

    def losses(self, samples: Samples, weights: Float[Tensor, "N"] | None) -> dict[str, Float[Tensor, ""]]:
        if samples.proposals is None or weights is None:
            return {}
        histograms, edges = samples.proposals
        main_weights = weights.detach().view(len(edges), -1)
        terms = [interlevel_loss(found.weights, found.edges, edges, main_weights) for found in histograms]
        return {"interlevel": functools.reduce(torch.add, terms)}

    @torch.no_grad()
    def restart(self, step: int) -> None:
        self.first_step = step
        self.grid.tables.zero_()

    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        self.step = step


def choose_sampler(bounds: Bounds, chunk: int = CHUNK) -> Sampler:
    """Returns a proposal sampler for unbounded scenes, where every ray hits something; else an occupancy grid sampler."""
    return ProposalSampler(bounds, chunk=chunk) if bounds.unbounded else OccupancySampler(bounds, chunk=chunk)
