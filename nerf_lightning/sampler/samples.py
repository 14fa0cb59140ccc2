"""Samples (packed intervals along rays) and the base class of samplers."""

import bisect
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from nerf_lightning.cameras import BoundedModule, Bounds, Cameras, Rays
from nerf_lightning.kernels import merge_low_weight, pack_intervals, ray_positions
from nerf_lightning.kernels.march import Packed

DensityFn = Callable[[Float[Tensor, "N 3"]], Float[Tensor, "N"]]
"""World positions -> density (1 / world unit)."""

CHUNK = 1 << 15
"""Default `chunk` of `Sampler` and `System`."""
SAMPLES_PER_RAY = 8
"""Typical number of samples per ray, which determines the ray chunk size."""
MIN_SAMPLE_WEIGHT = 0.01
"""Weight below which evaluation merges a sample with its neighbor: a quarter of Lego's at 800 pixels, for 0.001 dB."""


class Histogram(NamedTuple):
    """Weights of intervals along rays."""

    edges: Float[Tensor, "R S_plus_1"]
    """Interval edges in [0, 1], see `Bounds.s_to_t`."""
    weights: Float[Tensor, "R S"]


class Proposals(NamedTuple):
    """Proposal histograms and the intervals drawn from them."""

    histograms: tuple[Histogram, ...]
    """Histogram of each proposal pass, with gradient."""
    edges: Float[Tensor, "R K_plus_1"]
    """Edges of the samples, in [0, 1]."""


@dataclass(frozen=True)
class Samples:
    """N intervals on R rays, sorted by ray, then by distance. The count differs by ray and may be 0."""

    t: Float[Tensor, "N"]
    """Midpoint of each interval: distance along its ray."""
    dt: Float[Tensor, "N"]
    """Length of each interval."""
    ray: Int[Tensor, "N"]
    """Index of each sample's ray."""
    offsets: Int[Tensor, "R_plus_1"]
    """Samples of ray r are offsets[r] : offsets[r + 1]."""
    complete: Bool[Tensor, "R"] | None = None
    """With a fixed-size buffer, True for rays whose samples all fitted (unused slots hold intervals of length 0). None when
    the count is exact."""
    cached_positions: Float[Tensor, "N 3"] | None = None
    """World positions of the midpoints, if already computed."""
    optical_depth: Float[Tensor, "N"] | None = None
    """Optical depth (density times length) without gradient, if the sampler computed it without jitter."""
    proposals: Proposals | None = None
    """Proposals for `Sampler.losses`, in training."""

    def __len__(self) -> int:
        return self.t.shape[0]

    @property
    def packed(self) -> Packed:
        """Midpoints, lengths, rays and offsets."""
        return self.t, self.dt, self.ray, self.offsets

    def positions(self, rays: Rays) -> Float[Tensor, "N 3"]:
        """World positions of the midpoints."""
        if self.cached_positions is not None and not rays.origins.requires_grad:
            return self.cached_positions
        return ray_positions(rays.origins, rays.directions, self.ray, self.t)

    def directions(self, rays: Rays) -> Float[Tensor, "N 3"]:
        """Unit viewing direction of each sample."""
        return rays.directions.detach().index_select(0, self.ray)

    def clip(self, near: float, far: float) -> "Samples":
        """Samples whose midpoints lie between two distances along their rays."""
        keep = (self.t >= near) & (self.t <= far)
        before = torch.cat([keep.new_zeros(1, dtype=torch.int64), keep.cumsum(0)])
        offsets = before[self.offsets].to(self.offsets.dtype)
        return self._take(keep, self.ray[keep], offsets)

    def _take(self, index: Tensor | slice, ray: Int[Tensor, "M"], offsets: Int[Tensor, "Q"]) -> "Samples":
        """Selects evaluation samples (without proposals); `ray` and `offsets` belong to the selection."""
        positions, depth = (None if x is None else x[index] for x in (self.cached_positions, self.optical_depth))
        return Samples(self.t[index], self.dt[index], ray, offsets, None, positions, depth)

    def merge_low_weight_samples(self) -> "Samples":
        """Merges neighboring samples if one has less than `MIN_SAMPLE_WEIGHT`; no-op if the optical depth is unknown."""
        if self.optical_depth is None:
            return self
        optical_depth, packed = merge_low_weight(self.optical_depth, self.packed, MIN_SAMPLE_WEIGHT)
        return Samples(*packed, optical_depth=optical_depth)


def pack(edges: Float[Tensor, "R S_plus_1"], keep: Bool[Tensor, "R S"]) -> Samples:
    """Packs the kept intervals between consecutive edges of each ray."""
    return Samples(*pack_intervals(edges, keep))


def split_by_rays(samples: Samples, max_samples: int) -> Iterator[tuple[slice, Samples]]:
    """Splits samples into chunks of whole rays with at most `max_samples` samples (a ray with more forms a chunk alone).

    Yields:
        The chunk's rays as a slice, and their samples with `ray` and `offsets` relative to the chunk.
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
    """Base class of samplers. Without a generator (evaluation) samples are deterministic.

    Args:
        bounds: the box of the content.
        chunk: samples rendered at a time; samplers work on multiples of it.
    """

    render_state: tuple[str, ...] = ()
    """State keys that rendering needs, for compact files."""

    def __init__(self, bounds: Bounds, chunk: int = CHUNK):
        super().__init__(bounds)
        self.chunk = chunk

    @property
    def ray_chunk_size(self) -> int:
        """Rays sampled together in evaluation."""
        return max(1, self.chunk // SAMPLES_PER_RAY)

    @property
    def samples_per_ray(self) -> float | None:
        """Samples per ray at the last count, if training steps have buffers of fixed size; None: `Samples` holds them all."""
        return None

    @property
    def graph_key(self) -> Hashable:
        """Identifies steps that do the same on the device but for rays and random numbers; None for one with its own sizes."""
        return ()

    def read_counts(self) -> None:
        """Hook that reads sample counts from the device: a host-device sync."""

    def param_groups(self) -> list[dict[str, Any]]:
        """Named parameter groups of the optimizer for the sampler's parameters."""
        return []

    def lr_factors(self, progress: float) -> dict[str, float]:
        """Factors on the scheduled learning rate of these groups at this training progress, by name."""
        return {}

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        raise TypeError(f"{type(self).__name__} must define forward(rays, density, generator) -> Samples")

    def export_state(self) -> dict[str, Tensor]:
        """State that rendering needs, for `import_state`."""
        state = self.state_dict()
        return {name: state[name] for name in self.render_state}

    def import_state(self, state: dict[str, Tensor]) -> None:
        """Restores what `export_state` returned.

        Raises:
            RuntimeError, KeyError: if it came from another kind or size of sampler.
        """
        self.load_state_dict({name: state[name] for name in self.render_state}, strict=False)

    def warm_start_from(self, other: "Sampler") -> None:
        """Copies the state of a sampler of the same kind and size."""
        self.load_state_dict(other.state_dict())

    def mark_invisible_cells(self, cameras: Cameras) -> None:
        """Hook before training with the training cameras, for samplers that skip invisible cells."""

    def set_resolution_scale(self, scale: float) -> None:
        """Hook with the field's `resolution_scale`, for samplers whose steps follow it."""

    def restart(self, step: int) -> None:
        """Hook when training restarts at a step with a fresh field."""

    def losses(self, samples: Samples, weights: Float[Tensor, "N"] | None) -> dict[str, Float[Tensor, ""]]:
        """Losses of the sampler by name.

        Args:
            samples: output of `forward`.
            weights: rendering weights of the main field, if known.
        """
        return {}

    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        """Hook before each training step, for samplers that adapt to the content."""
