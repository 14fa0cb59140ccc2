"""Scene bounds, and the contraction of world positions into the unit cube of the grids."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras.cameras import Rays
from nerf_lightning.utils.tensor_dataclass import TensorDataclass

UNBOUNDED_FAR_HALF_SIZES = 50.0
"""Far plane of an unbounded scene, in half-sizes of the box."""
REFERENCE_WIDTH_PX = 200
"""Width of the content in the photos for which the default grid resolutions are chosen."""
MAX_RESOLUTION_SCALE = 2.0
"""Largest `Bounds.resolution_scale`, that of content 800 pixels wide; an occupancy grid costs its cube."""


@dataclass(frozen=True)
class Bounds(TensorDataclass):
    """An axis-aligned box around the content, in world units.

    A bounded scene has no content outside the box. An unbounded one keeps full resolution inside the box and contracts
    the outside into a shell of the unit cube (mip-NeRF 360, eq. 10, with the max norm).
    """

    aabb: Float[Tensor, "2 3"]
    """Lower and upper corner."""
    unbounded: bool = False
    near: float | None = None
    """Overrides the near plane, distance along the ray; None takes it from the box."""
    far: float | None = None
    pixel_footprint: float | None = None
    """Footprint of a photo's pixel at the content, world units; None if unknown."""

    center: Float[Tensor, "3"] = field(init=False, repr=False)
    half_size: Float[Tensor, "3"] = field(init=False, repr=False)
    max_half_size: float = field(init=False, repr=False)
    _low: Float[Tensor, "3"] = field(init=False, repr=False)
    _size: Float[Tensor, "3"] = field(init=False, repr=False)
    _scale: Float[Tensor, "3"] = field(init=False, repr=False)
    _offset: Float[Tensor, "3"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        with torch.inference_mode(False):  # they enter autograd even if created in inference mode
            center, half_size = self.aabb.mean(0), (self.aabb[1] - self.aabb[0]) / 2
            derived = {"center": center, "half_size": half_size, "max_half_size": float(half_size.max())}
            low, size = center - half_size, 2 * half_size
            derived |= {"_low": low, "_size": size, "_scale": 1 / size, "_offset": -low / size}
            for name, value in derived.items():
                object.__setattr__(self, name, value)

    @property
    def unit_cube_pixels(self) -> float:
        """Photo pixels along the unit cube's longest edge, at their footprint in the box."""
        if self.pixel_footprint is None:
            return math.inf
        # The contraction maps the box to the middle half of the unit cube.
        return (4 if self.unbounded else 2) * self.max_half_size / self.pixel_footprint

    @property
    def resolution_scale(self) -> float:
        """Factor by which grids are finer than the default: sqrt(content width / 200 px) in [1, MAX_RESOLUTION_SCALE].

        The parameters of planes then grow linearly with the content's width; pixel-sized cells would learn too slowly.
        1 for unbounded scenes, where it was not measured.
        """
        if self.unbounded or self.pixel_footprint is None:
            return 1.0
        return min(max(1.0, math.sqrt(self.unit_cube_pixels / REFERENCE_WIDTH_PX)), MAX_RESOLUTION_SCALE)

    def to_unit(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Maps world positions to [0, 1]^3, beyond it outside a bounded box; contracts those of an unbounded scene into it."""
        if not self.unbounded and positions.device.type == "cpu":
            return (positions - self._low).div_(self._size)
        if not self.unbounded:
            return torch.addcmul(self._offset, positions, self._scale)  # a single kernel
        local = (positions - self.center) / self.half_size
        norm = local.abs().amax(-1, keepdim=True).clamp_min(1.0)
        return (2.0 - 1.0 / norm) * (local / norm) * 0.25 + 0.5

    def to_world(self, unit: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Inverse of `to_unit`."""
        if not self.unbounded:
            return (unit * 2 - 1) * self.half_size + self.center
        contracted = (unit - 0.5) * 4
        norm = contracted.abs().amax(-1, keepdim=True)
        outside = contracted / (norm * (2.0 - norm).clamp_min(1e-6)).clamp_min(1e-6)
        return torch.where(norm <= 1, contracted, outside) * self.half_size + self.center

    def near_far(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
        """Near and far distance of each ray; near >= far if it misses.

        Bounded: the slab test against the box. Unbounded: from 0.02 to `UNBOUNDED_FAR_HALF_SIZES` half-sizes.
        """
        if self.unbounded:
            size = self.max_half_size
            near = torch.full_like(rays.origins[:, 0], 0.02 * size if self.near is None else self.near)
            return near, torch.full_like(near, UNBOUNDED_FAR_HALF_SIZES * size if self.far is None else self.far)
        enter, leave = self._intersect_aabb(rays)
        near = enter.clamp_min(0.0 if self.near is None else max(self.near, 0.0))
        return near, leave if self.far is None else leave.clamp_max(self.far)

    def _intersect_aabb(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
        """Entry and exit distance of each ray's line, by the slab test; exit < entry if it misses."""
        # A zero component never crosses its slab: clamped, the division gives +-huge instead of NaN.
        safe = rays.directions.masked_fill(rays.directions.abs() < 1e-9, 1e-9)
        crossings = (self.aabb[:, None] - rays.origins) / safe
        return crossings.amin(0).amax(-1), crossings.amax(0).amin(-1)

    def content_interval(self, rays: Rays) -> Float[Tensor, "R 2"]:
        """Entry and exit distance of each ray; if it misses, twice that nearest to the box's center. May be negative."""
        enter, leave = self._intersect_aabb(rays)
        closest = ((self.center - rays.origins) * rays.directions).sum(-1)
        return torch.stack([torch.where(enter < leave, end, closest) for end in (enter, leave)], dim=-1)

    def s_to_t(
        self, rays: Rays, near: Float[Tensor, "R"], far: Float[Tensor, "R"], s: Float[Tensor, "*#R S"]
    ) -> Float[Tensor, "R S"]:
        """Maps s in [0, 1] to distances: linear if bounded; if not, linear inside the box, sparser outside.

        The unbounded map is uniform in `warp`, as mip-NeRF 360's samples are in contracted space (section 3): outside the
        box, step size grows with the square of 1 + the distance to the box in half-sizes.
        """
        near, far = near[:, None], torch.maximum(far, near)[:, None]
        if not self.unbounded:
            return near + (far - near) * s
        interval, unit = self.content_interval(rays), self.max_half_size
        start = warp(near, interval, unit)
        return unwarp(start + (warp(far, interval, unit) - start) * s, interval, unit)


def warp(t: Float[Tensor, "R S"], interval: Float[Tensor, "R 2"], unit: float) -> Float[Tensor, "R S"]:
    """Warped distances along rays, in which samples are uniform: 0 at the start of `interval`, growing by 1 per `unit` up to
    its end, and by x / (1 + x) in total over x units beyond either end."""
    enter, leave = interval[:, :1], interval[:, 1:]
    front, back = ((enter - t) / unit).clamp_min(0), ((t - leave) / unit).clamp_min(0)
    middle = (torch.minimum(torch.maximum(t, enter), leave) - enter) / unit
    return 1 / (1 + front) - 1 / (1 + back) + middle


def unwarp(y: Float[Tensor, "R S"], interval: Float[Tensor, "R 2"], unit: float) -> Float[Tensor, "R S"]:
    """Inverse of `warp`."""
    enter, leave = interval[:, :1], interval[:, 1:]
    length = (leave - enter) / unit
    front = 1 / (1 + y.clamp(-1 + 1e-6, 0)) - 1
    back = 1 / (1 - (y - length).clamp(0, 1 - 1e-6)) - 1
    return torch.where(y < 0, enter - unit * front, torch.where(y > length, leave + unit * back, enter + unit * y))


class BoundedModule(torch.nn.Module):
    """Base of modules with scene bounds, which move between devices with the module."""

    def __init__(self, bounds: Bounds):
        super().__init__()
        self.bounds = bounds

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "BoundedModule":
        self.bounds = self.bounds.map_tensors(fn)
        return super()._apply(fn, recurse)
