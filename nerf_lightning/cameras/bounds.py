"""Bounds: where the scene's content is, and how world positions map to the unit cube that grids live in."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras.cameras import Rays
from nerf_lightning.utils.tensor_dataclass import TensorDataclass

UNBOUNDED_FAR_HALF_SIZES = 50.0
"""An unbounded scene is sampled out to this many half-sizes of the box; beyond, it looks like a picture at infinity."""
REFERENCE_WIDTH_PX = 200
"""Pixels that the content is wide in photos for which sizes of grids are stated."""
MAX_RESOLUTION_SCALE = 2.0
"""Most that `Bounds.resolution_scale` is: content of 800 pixels; an occupancy grid costs its cube."""


@dataclass(frozen=True)
class Bounds(TensorDataclass):
    """An axis-aligned box around the content, in world units.

    A bounded scene has nothing outside the box. An unbounded one keeps the box at full detail and contracts everything
    outside it into a shell of the unit cube (mip-NeRF 360, eq. 10, with the max norm).
    """

    aabb: Float[Tensor, "2 3"]
    """Lower and upper corner."""
    unbounded: bool = False
    near: float | None = None
    """Overrides the distance along the ray where sampling starts; None takes it from the box."""
    far: float | None = None
    pixel_footprint: float | None = None
    """Width of what one pixel of the photos shows at the content, world units; None if unknown."""

    centre: Float[Tensor, "3"] = field(init=False, repr=False)
    half_size: Float[Tensor, "3"] = field(init=False, repr=False)
    max_half_size: float = field(init=False, repr=False)
    """The largest of the half-sizes."""
    _low: Float[Tensor, "3"] = field(init=False, repr=False)
    _size: Float[Tensor, "3"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        with torch.inference_mode(False):  # they take part in gradients, wherever they were made
            centre, half_size = self.aabb.mean(0), (self.aabb[1] - self.aabb[0]) / 2
            derived = {"centre": centre, "half_size": half_size, "max_half_size": float(half_size.max())}
            for name, value in (derived | {"_low": centre - half_size, "_size": 2 * half_size}).items():
                object.__setattr__(self, name, value)

    @property
    def unit_cube_pixels(self) -> float:
        """Pixels along the unit cube's longest edge, at the size they have in the box."""
        if self.pixel_footprint is None:
            return math.inf
        # The contraction leaves the middle half of the unit cube to the box.
        return (4 if self.unbounded else 2) * self.max_half_size / self.pixel_footprint

    @property
    def resolution_scale(self) -> float:
        """How much finer than usual the photos let grids be: the square root of how much wider the content is in them, at
        least 1 and at most `MAX_RESOLUTION_SCALE`.

        Planes then have as many more numbers as it is wider; cells as fine as the pixels would take too long to learn. Of
        unbounded scenes, whose numbers have other things to show, this was not measured: 1.
        """
        if self.unbounded or self.pixel_footprint is None:
            return 1.0
        return min(max(1.0, math.sqrt(self.unit_cube_pixels / REFERENCE_WIDTH_PX)), MAX_RESOLUTION_SCALE)

    def to_unit(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """World positions -> [0, 1]^3. Bounded: outside the box leaves the unit cube. Unbounded: never leaves it."""
        if not self.unbounded:
            return (positions - self._low).div_(self._size)
        local = (positions - self.centre) / self.half_size
        norm = local.abs().amax(-1, keepdim=True).clamp_min(1.0)
        return (2.0 - 1.0 / norm) * (local / norm) * 0.25 + 0.5

    def to_world(self, unit: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The inverse of `to_unit`."""
        if not self.unbounded:
            return (unit * 2 - 1) * self.half_size + self.centre
        contracted = (unit - 0.5) * 4
        norm = contracted.abs().amax(-1, keepdim=True)
        outside = contracted / (norm * (2.0 - norm).clamp_min(1e-6)).clamp_min(1e-6)
        return torch.where(norm <= 1, contracted, outside) * self.half_size + self.centre

    def near_far(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
        """Distances along each ray between which it can meet content; near >= far if it misses.

        Bounded: the slab test against the box. Unbounded: from a small clearance to `UNBOUNDED_FAR_HALF_SIZES` half-sizes.
        """
        if self.unbounded:
            size = self.max_half_size
            near = torch.full_like(rays.origins[:, 0], 0.02 * size if self.near is None else self.near)
            return near, torch.full_like(near, UNBOUNDED_FAR_HALF_SIZES * size if self.far is None else self.far)
        enter, leave = self._intersect_aabb(rays)
        near = enter.clamp_min(0.0 if self.near is None else max(self.near, 0.0))
        return near, leave if self.far is None else leave.clamp_max(self.far)

    def _intersect_aabb(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
        """Where each ray's line enters and leaves the box, by the slab test: leave < enter if it misses."""
        # A zero component never crosses its slab: nudged, the division gives +-huge instead of NaN.
        safe = rays.directions.masked_fill(rays.directions.abs() < 1e-9, 1e-9)
        crossings = (self.aabb[:, None] - rays.origins) / safe
        return crossings.amin(0).amax(-1), crossings.amax(0).amin(-1)

    def content_interval(self, rays: Rays) -> Float[Tensor, "R 2"]:
        """Distances between which each ray is closest to the content: inside the box, or if it misses, twice the point nearest
        to the box's centre. They may be negative."""
        enter, leave = self._intersect_aabb(rays)
        closest = ((self.centre - rays.origins) * rays.directions).sum(-1)
        return torch.stack([torch.where(enter < leave, end, closest) for end in (enter, leave)], dim=-1)

    def s_to_t(
        self, rays: Rays, near: Float[Tensor, "R"], far: Float[Tensor, "R"], s: Float[Tensor, "*#R S"]
    ) -> Float[Tensor, "R S"]:
        """Maps s in [0, 1] to distances: linear when bounded; when not, linear inside the box, thinning out from it.

        The unbounded map is even in `warp`, as mip-NeRF 360's samples are in contracted space (section 3): in front of the box
        and behind it, a step grows with the square of 1 + the distance to the box in half-sizes.
        """
        near, far = near[:, None], torch.maximum(far, near)[:, None]
        if not self.unbounded:
            return near + (far - near) * s
        interval, unit = self.content_interval(rays), self.max_half_size
        start = warp(near, interval, unit)
        return unwarp(start + (warp(far, interval, unit) - start) * s, interval, unit)


def warp(t: Float[Tensor, "R S"], interval: Float[Tensor, "R 2"], unit: float) -> Float[Tensor, "R S"]:
    """Distances along rays as coordinates in which samples are even: 0 at the near end of `interval`, growing by 1 per `unit`
    up to its far end, and by x / (1 + x) in total over x units beyond either end."""
    enter, leave = interval[:, :1], interval[:, 1:]
    front, back = ((enter - t) / unit).clamp_min(0), ((t - leave) / unit).clamp_min(0)
    middle = (torch.minimum(torch.maximum(t, enter), leave) - enter) / unit
    return 1 / (1 + front) - 1 / (1 + back) + middle


def unwarp(y: Float[Tensor, "R S"], interval: Float[Tensor, "R 2"], unit: float) -> Float[Tensor, "R S"]:
    """The inverse of `warp`."""
    enter, leave = interval[:, :1], interval[:, 1:]
    length = (leave - enter) / unit
    front = 1 / (1 + y.clamp(-1 + 1e-6, 0)) - 1
    back = 1 / (1 - (y - length).clamp(0, 1 - 1e-6)) - 1
    return torch.where(y < 0, enter - unit * front, torch.where(y > length, leave + unit * back, enter + unit * y))


class BoundedModule(torch.nn.Module):
    """Base of modules that live in a scene's bounds; the box follows the module from device to device."""

    def __init__(self, bounds: Bounds):
        super().__init__()
        self.bounds = bounds

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "BoundedModule":
        """What moves the module moves its bounds."""
        self.bounds = self.bounds.map_tensors(fn)
        return super()._apply(fn, recurse)
