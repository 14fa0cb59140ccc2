"""Color correction: gains of each photo's exposure and white balance, and vignetting, learned with the field."""

import copy
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Cameras, Projection, Rays
from nerf_lightning.errors import InputError

GAMMA = 2.2
"""Of sRGB, about: pixels grow with the light to the power of 1 / GAMMA."""


class ColorCorrection(torch.nn.Module):
    """Gains of V photos' colours; at the start all are 1.

    Args:
        cameras: of the photos, as given.
        exposures: light that each photo gathered, in any unit, as its file states; empty where that is not known.
        affine: whether the colours of each photo are mixed and shifted too.
        vignetting: whether photos may be darker toward their corners, all alike.
        fix_mean: whether the mean of all gains stays 1, so that the scene does not grow brighter.

    Raises:
        InputError: for vignetting of photos of all directions.
    """

    exif_log_gains: Tensor
    optical_axes: Tensor

    def __init__(
        self,
        cameras: Cameras,
        exposures: Sequence[float] = (),
        affine: bool = False,
        vignetting: bool = False,
        fix_mean: bool = True,
    ):
        super().__init__()
        lenses = cameras.lenses
        if vignetting and lenses is not None and bool((lenses.projection == Projection.EQUIRECTANGULAR).any()):
            raise InputError("refine.vignetting", "", "true, with photos of all directions", "false for these")
        logs = torch.tensor(exposures).log() / GAMMA if exposures else torch.zeros(len(cameras))
        self.register_buffer("exif_log_gains", (logs - logs.mean())[:, None].expand(-1, 3).clone(), persistent=False)
        self.register_buffer("optical_axes", cameras.c2w[:, :3, 2].clone(), persistent=False)
        half = cameras.sizes.to(cameras.K) / 2
        corners = torch.maximum(cameras.K[:, :2, 2], 2 * half - cameras.K[:, :2, 2])
        self.corner_tan_squared = float((corners / cameras.K[:, [0, 1], [0, 1]]).square().sum(1).max())
        """Of the angle to the axis in the farthest corner."""
        self.log_gains = torch.nn.Parameter(torch.zeros(len(cameras), 3), requires_grad=False)
        self.color_matrices = (
            torch.nn.Parameter(torch.zeros(len(cameras), 3, 4), requires_grad=False) if affine else None
        )
        self.vignetting_coefficients = torch.nn.Parameter(torch.zeros(2), requires_grad=False) if vignetting else None
        self.fix_mean = fix_mean

    @property
    def is_active(self) -> bool:
        """Whether colours are corrected."""
        return self.log_gains.requires_grad

    @property
    def gains(self) -> Float[Tensor, "V 3"]:
        """Factors on each photo's red, green and blue."""
        return self._subtract_mean(self.log_gains).exp()

    @property
    def corner_brightness(self) -> Float[Tensor, ""] | None:
        """Of the farthest corner, as a share of that on the axis, if photos may have vignetting."""
        return None if self.vignetting_coefficients is None else (-self.vignetting_coefficients.sum()).exp()

    def init_from_exif(self) -> None:
        """Starts from the exposures that files state."""
        self.log_gains.data.copy_(self.exif_log_gains)

    def copy_lens(self, other: "ColorCorrection") -> None:
        """Takes the vignetting of another correction, not learned any further."""
        self.vignetting_coefficients, self.corner_tan_squared = (
            copy.deepcopy(other.vignetting_coefficients),
            other.corner_tan_squared,
        )
        if self.vignetting_coefficients is not None:
            self.vignetting_coefficients.requires_grad_(False)

    def _subtract_mean(self, values: Float[Tensor, "V *K"]) -> Float[Tensor, "V *K"]:
        return values - values.mean(0) if self.fix_mean else values

    def forward(
        self,
        rgb: Float[Tensor, "R 3"],
        opacity: Float[Tensor, "R"],
        backgrounds: Float[Tensor, "R 3"],
        rays: Rays,
        views: Int[Tensor, "R"],
        truth: Float[Tensor, "R 3"] | None = None,
    ) -> Float[Tensor, "R 3"]:
        """Rendered colours as these photos show them; what is behind stays as it is.

        Where a photo's own colours are given and are burnt out (1), those that are brighter still count as equal.

        Args:
            rgb, opacity: rendered.
            backgrounds: colours behind.
            rays: the pixels' rays, by the cameras as given.
            views: the photos.
            truth: their own colours.
        """
        if not self.is_active:
            return rgb
        background = (1 - opacity)[:, None] * backgrounds
        foreground = rgb - background
        corrected_foreground = foreground * self.gains.index_select(0, views)
        if self.color_matrices is not None:
            matrix, shift = self._subtract_mean(self.color_matrices).index_select(0, views).split((3, 1), dim=2)
            corrected_foreground = (
                corrected_foreground + (matrix * foreground[:, None]).sum(2) + shift[..., 0] * opacity[:, None]
            )
        if self.vignetting_coefficients is not None:
            corrected_foreground = corrected_foreground * self.compute_vignetting(rays.directions, views)
        corrected = corrected_foreground + background
        return corrected if truth is None else torch.where(truth >= 1, corrected.clamp_max(1), corrected)

    def compute_vignetting(self, directions: Float[Tensor, "R 3"], views: Int[Tensor, "R"]) -> Float[Tensor, "R 1"]:
        """Factor on the colours of pixels with these directions of the cameras as given: 1 on the axis.

        exp(-a r^2 - b r^4), where r is the tangent of the angle to the axis, 1 in the farthest corner.
        """
        assert self.vignetting_coefficients is not None  # asked for by the caller
        cosine = (directions * self.optical_axes.index_select(0, views)).sum(1, keepdim=True)
        tan_squared = cosine.square().clamp_min(torch.finfo(cosine.dtype).eps).reciprocal() - 1
        square = tan_squared / self.corner_tan_squared
        first, second = self.vignetting_coefficients
        return torch.exp(-square * (first + square * second))
