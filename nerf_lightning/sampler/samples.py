"""Samples: intervals along rays, packed one ray after the other, and the interface of all samplers."""

import bisect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from nerf_lightning.cameras import BoundedModule, Bounds, Cameras, Rays
from nerf_lightning.kernels import merge_low_weight, pack_intervals, ray_positions

DensityFn = Callable[[Float[Tensor, "N 3"]], Float[Tensor, "N"]]
"""World positions -> density (1 / world unit); all that samplers know of a field."""


CHUNK = 1 << 15
"""Default of `Sampler`'s and `System`'s chunk."""
SAMPLES_PER_RAY = 8
"""That a ray takes about; most rays take few, or many that need little memory."""
MIN_SAMPLE_WEIGHT = 0.01
"""Weight below which a sample of a picture takes its neighbour's colour: a quarter of Lego's at 800 pixels, for 0.001 dB."""


class Histogram(NamedTuple):
    """Weights of intervals along rays."""

    edges: Float[Tensor, "R S_plus_1"]
    """In [0, 1], see `Bounds.s_to_t`."""
    weights: Float[Tensor, "R S"]


class Proposals(NamedTuple):
    """How a sampler came to as many samples on every ray."""

    histograms: tuple[Histogram, ...]
    """What it expected, with gradient."""
    edges: Float[Tensor, "R K_plus_1"]
    """Of the samples, likewise in [0, 1]."""


@dataclass(frozen=True)
class Samples:
    """N intervals over R rays, sorted by ray, then by distance. Rays may hold different counts, or none."""

    t: Float[Tensor, "N"]
    """Midpoint of each interval: distance along its ray."""
    dt: Float[Tensor, "N"]
    """Length of each interval."""
    ray: Int[Tensor, "N"]
    """Index of each sample's ray."""
    offsets: Int[Tensor, "R_plus_1"]
    """Samples of ray r are offsets[r] : offsets[r + 1]."""
    complete: Bool[Tensor, "R"] | None = None
    """Which rays have all their samples, if the number of samples was fixed before they were found: some rays may then lack
    some, or intervals of length 0 fill the end. None: all rays have all."""
    cached_positions: Float[Tensor, "N 3"] | None = None
    """World positions of the midpoints, if already known."""
    optical_depth: Float[Tensor, "N"] | None = None
    """Optical thickness, density times length, if the sampler found it without randomness; it carries no gradient."""
    proposals: Proposals | None = None
    """What the sampler learns from in training, see `Sampler.loss`."""

    def __len__(self) -> int:
        return self.t.shape[0]

    def positions(self, rays: Rays) -> Float[Tensor, "N 3"]:
        """World positions of the midpoints."""
        if self.cached_positions is not None and not rays.origins.requires_grad:
            return self.cached_positions
        return ray_positions(rays.origins, rays.directions, self.ray, self.t)

    def directions(self, rays: Rays) -> Float[Tensor, "N 3"]:
        """Unit viewing direction of each sample."""
        return rays.directions.detach().index_select(0, self.ray)

    def clip(self, near: float, far: float) -> "Samples":
        """The samples whose midpoints lie between two distances along their rays."""
        keep = (self.t >= near) & (self.t <= far)
        before = torch.cat([keep.new_zeros(1, dtype=torch.int64), keep.cumsum(0)])
        offsets = before[self.offsets].to(self.offsets.dtype)
        return self._take(keep, self.ray[keep], offsets)

    def _take(self, index: Tensor | slice, ray: Int[Tensor, "M"], offsets: Int[Tensor, "Q"]) -> "Samples":
        """Some of the samples of a picture, which belong to these rays."""
        optical_depth = None if self.optical_depth is None else self.optical_depth[index]
        return Samples(self.t[index], self.dt[index], ray, offsets, optical_depth=optical_depth)

    def merge_low_weight_samples(self) -> "Samples":
        """For pictures: fewer samples, those below `MIN_SAMPLE_WEIGHT` share a colour; as it is where thickness is not
        known. The t of two that became one is where their weight is."""
        if self.optical_depth is None:
            return self
        optical_depth, packed = merge_low_weight(
            self.optical_depth, (self.t, self.dt, self.ray, self.offsets), MIN_SAMPLE_WEIGHT
        )
        return Samples(*packed, optical_depth=optical_depth)


def interval_weights(optical_depth: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """How much each interval contributes to its ray's pixel, from its density times its length: see `volume_weights`."""
    return torch.exp(optical_depth - optical_depth.cumsum(1)) * -torch.expm1(-optical_depth)


def pack(edges: Float[Tensor, "R S_plus_1"], keep: Bool[Tensor, "R S"]) -> Samples:
    """Packs the kept intervals between consecutive edges of each ray."""
    return Samples(*pack_intervals(edges, keep))


def split_by_rays(samples: Samples, max_samples: int) -> Iterator[tuple[slice, Samples]]:
    """Splits samples into runs of whole rays with at most `max_samples` samples each (a ray with more is a run of its own).

    Yields:
        A run's rays as a slice, and their samples with `ray` and `offsets` counted from the run's start.
    """
    offsets = samples.offsets.tolist()
    first, rays = 0, len(offsets) - 1
    while first < rays:
        last = max(first + 1, bisect.bisect_right(offsets, offsets[first] + max_samples, lo=first) - 1)
        part = slice(offsets[first], offsets[last])
        local = samples.offsets[first : last + 1] - offsets[first]
        yield slice(first, last), samples._take(part, samples.ray[part] - first, local)
        first = last


class Sampler(BoundedModule):
    """Base of samplers. Without a generator (evaluation) the samples are not random.

    Args:
        bounds: where the content is.
        chunk: samples that a device renders at a time; samplers work on multiples of it.
    """

    render_state: tuple[str, ...] = ()
    """Names of what rendering needs of its state, for compact files."""

    def __init__(self, bounds: Bounds, chunk: int = CHUNK):
        super().__init__(bounds)
        self.chunk = chunk

    @property
    def ray_chunk_size(self) -> int:
        """Rays to sample together without gradient."""
        return max(1, self.chunk // SAMPLES_PER_RAY)

    def param_groups(self) -> list[dict[str, Any]]:
        """The optimiser's groups of what is learned at a rate of its own, each with a name."""
        return []

    def lr_factors(self, progress: float) -> dict[str, float]:
        """Factors on the scheduled learning rate of these groups after this share of the training, by name."""
        return {}

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        raise TypeError(f"{type(self).__name__} must define forward(rays, density, generator) -> Samples")

    def export_state(self) -> dict[str, Tensor]:
        """What rendering needs, for `import_state`."""
        state = self.state_dict()
        return {name: state[name] for name in self.render_state}

    def import_state(self, state: dict[str, Tensor]) -> None:
        """Restores what `export_state` returned.

        Raises:
            RuntimeError, KeyError: if it came from another kind or size of sampler.
        """
        self.load_state_dict({name: state[name] for name in self.render_state}, strict=False)

    def warm_start_from(self, other: "Sampler") -> None:
        """Copies what another sampler of the same kind and size has learned."""
        self.load_state_dict(other.state_dict())

    def mark_invisible_cells(self, cameras: Cameras) -> None:
        """Called before training with the photos' cameras, for samplers that skip what no camera sees."""

    def set_resolution_scale(self, scale: float) -> None:
        """Called with the field's `resolution_scale`, for samplers whose steps follow it."""

    def restart(self, step: int) -> None:
        """Called when training starts again at a step, with a fresh field."""

    def losses(self, samples: Samples, weights: Float[Tensor, "N"] | None) -> dict[str, Float[Tensor, ""]]:
        """Losses by name from which the sampler learns.

        Args:
            samples: that it gave.
            weights: how much each contributed to its ray's pixel, if known.
        """
        return {}

    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        """Called before each training step, for samplers that learn where the content is."""
