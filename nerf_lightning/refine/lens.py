"""What may be wrong with the lens that took all photos: its focal length, and that it darkens their corners."""

import copy

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Cameras, Projection
from nerf_lightning.errors import InputError


class LensCorrections(torch.nn.Module):
    """One factor on the focal length of all photos, and one vignetting; at the start there is neither.

    Args:
        cameras: of the V photos, as given.
        focal: whether the focal length is corrected.
        vignetting: whether photos may be darker toward their corners.

    Raises:
        InputError: for a focal length of lenses that have none, or vignetting of photos of all directions.
    """

    axes: Tensor

    def __init__(self, cameras: Cameras, focal: bool, vignetting: bool):
        super().__init__()
        if cameras.lenses is not None:
            projection = cameras.lenses.projection
            if focal and bool((projection != Projection.PERSPECTIVE).any()):
                found = "true, with fisheye lenses or photos of all directions"
                raise InputError("refine.focal", "", found, "false for these")
            if vignetting and bool((projection == Projection.EQUIRECTANGULAR).any()):
                raise InputError("refine.vignetting", "", "true, with photos of all directions", "false for these")
        self.register_buffer("axes", cameras.c2w[:, :3, 2].clone(), persistent=False)
        half = cameras.sizes.to(cameras.K) / 2
        corners = torch.maximum(cameras.K[:, :2, 2], 2 * half - cameras.K[:, :2, 2])
        self.scale = float(2 / half.norm(dim=1).median())
        """So that `zoom` is in pixels halfway to the corners."""
        self.reach = float((corners / cameras.K[:, [0, 1], [0, 1]]).square().sum(1).max())
        """Squared tangent of the angle to the axis in the farthest corner."""
        self.zoom = torch.nn.Parameter(torch.zeros(()), requires_grad=False) if focal else None
        self.darkening = torch.nn.Parameter(torch.zeros(2), requires_grad=False) if vignetting else None

    def of(self, cameras: Cameras) -> "LensCorrections":
        """The same lens before other cameras, not learned any further."""
        other = copy.deepcopy(self).requires_grad_(False)
        other.axes = cameras.c2w[:, :3, 2].clone()
        return other

    @property
    def focal_factor(self) -> Float[Tensor, ""] | None:
        """On the focal length, if that is corrected."""
        return None if self.zoom is None else (self.scale * self.zoom).exp()

    @property
    def corner(self) -> Float[Tensor, ""] | None:
        """Brightness of the farthest corner, as a share of that on the axis, if photos may have vignetting."""
        return None if self.darkening is None else (-self.darkening.sum()).exp()

    def zoomed(self, directions: Float[Tensor, "R 3"], views: Int[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        """Directions through the same pixels, of unit length, by the corrected focal length."""
        if (factor := self.focal_factor) is None:
            return directions
        axes = self.axes.index_select(0, views)
        ahead = (directions * axes).sum(1, keepdim=True) * axes
        return torch.nn.functional.normalize(ahead + (directions - ahead) / factor, dim=1)

    def shade(self, directions: Float[Tensor, "R 3"], views: Int[Tensor, "R"]) -> Float[Tensor, "R 1"]:
        """Factor on the colours of pixels with these directions of the cameras as given: 1 on the axis.

        exp(-a r^2 - b r^4), where r is the tangent of the angle to the axis, 1 in the farthest corner.
        """
        assert self.darkening is not None  # asked for by the caller
        ahead = (directions * self.axes.index_select(0, views)).sum(1, keepdim=True)
        square = (ahead.square().clamp_min(torch.finfo(ahead.dtype).eps).reciprocal() - 1) / self.reach
        first, second = self.darkening
        return torch.exp(-square * (first + square * second))
