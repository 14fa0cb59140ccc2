"""Bounds: where the scene's content is, and how world positions map to the unit cube that grids live in."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras.cameras import Rays

UNBOUNDED_REACH = 50.0
"""An unbounded scene is sampled out to this many box half-sizes; what is beyond looks like a picture at infinity."""


@dataclass(frozen=True)
class Bounds:
    """An axis-aligned box around the content, in world units.

    A bounded scene has nothing outside the box. An unbounded one keeps the box at full detail and contracts all that is
    outside it into a shell of the unit cube (mip-NeRF 360, eq. 10, with the max norm).
    """

    aabb: Float[Tensor, "2 3"]
    """Lower and upper corner."""
    unbounded: bool = False
    near: float | None = None
    """Overrides the distance along the ray where sampling starts; None takes it from the box."""
    far: float | None = None
    pixel: float | None = None
    """Width of what one pixel of the photos shows at the content, world units; None where that is not known."""

    @property
    def centre(self) -> Float[Tensor, "3"]:
        return self.aabb.mean(0)

    @property
    def half_size(self) -> Float[Tensor, "3"]:
        return (self.aabb[1] - self.aabb[0]) / 2

    @property
    def pixels_across(self) -> float:
        """How many pixels lie side by side along the unit cube's longest edge, if all showed what those in the box show."""
        if self.pixel is None:
            return math.inf
        # The contraction leaves the middle half of the unit cube to the box.
        return (4 if self.unbounded else 2) * float(self.half_size.max()) / self.pixel

    def to(self, device: torch.device | str) -> "Bounds":
        return replace(self, aabb=self.aabb.to(device))

    def to_unit(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """World positions -> [0, 1]^3. Bounded: outside the box leaves the unit cube. Unbounded: never leaves it."""
        local = (positions - self.centre) / self.half_size
        if not self.unbounded:
            return local * 0.5 + 0.5
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
        """Distances along each ray between which it can meet content; near >= far where it misses.

        Bounded: the slab test against the box. Unbounded: from a small clearance to `UNBOUNDED_REACH` half-sizes.
        """
        if self.unbounded:
            size = float(self.half_size.max())
            near = torch.full_like(rays.origins[:, 0], 0.02 * size if self.near is None else self.near)
            return near, torch.full_like(near, UNBOUNDED_REACH * size if self.far is None else self.far)
        # A zero component never crosses its slab: nudge it, so that the division gives +-huge instead of nan.
        safe = torch.where(rays.directions.abs() < 1e-9, torch.full_like(rays.directions, 1e-9), rays.directions)
        crossings = (self.aabb[:, None] - rays.origins) / safe
        near = crossings.amin(0).amax(-1).clamp_min(0.0 if self.near is None else max(self.near, 0.0))
        far = crossings.amax(0).amin(-1)
        return near, far if self.far is None else far.clamp_max(self.far)

    def distances(
        self, near: Float[Tensor, "R"], far: Float[Tensor, "R"], s: Float[Tensor, "*#R S"]
    ) -> Float[Tensor, "R S"]:
        """Maps s in [0, 1] to distances: linear when bounded, linear then linear in disparity when not.

        The unbounded map is uniform in g(t) = t/2 below the unit length u, 1 - u/(2t) above it, so samples thin out with
        distance as pixels do (nerfacto's piecewise spacing); u is the box's half-size.
        """
        near, far = near[:, None], torch.maximum(far, near)[:, None]
        if not self.unbounded:
            return near + (far - near) * s
        unit = self.half_size.max()

        def g(t: Tensor) -> Tensor:
            x = t / unit
            return torch.where(x < 1, x / 2, 1 - 1 / (2 * x.clamp_min(1.0)))

        y = g(near) + (g(far) - g(near)) * s
        return unit * torch.where(y < 0.5, 2 * y, 1 / (2 - 2 * y).clamp_min(1e-6))


class InBounds(torch.nn.Module):
    """Base of modules that live in a scene's bounds; the box follows the module from device to device."""

    aabb: Tensor

    def __init__(self, bounds: Bounds):
        super().__init__()
        self._bounds = bounds
        self.register_buffer("aabb", bounds.aabb.clone(), persistent=False)

    @property
    def bounds(self) -> Bounds:
        return replace(self._bounds, aabb=self.aabb)
