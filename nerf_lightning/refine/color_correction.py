"""Color correction: per-photo gains of exposure and white balance, and vignetting, learned with the field."""

import copy
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Cameras, Projection, Rays
from nerf_lightning.errors import InputError

GAMMA = 2.2
"""Approximate gamma of sRGB: pixel values grow with radiance^(1 / GAMMA)."""


class ColorCorrection(torch.nn.Module):
    """Color gains of V photos, initially 1.

    Args:
        cameras: of the photos, as given.
        exposures: exposure of each photo from its metadata, in any unit; empty if unknown.
        affine: also learns a 3x4 color matrix of each photo.
        vignetting: also learns darker corners, the same in all photos.
        fix_mean: keeps the mean gain at 1, so that the scene does not brighten.

    Raises:
        InputError: for vignetting of equirectangular photos.
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
            raise InputError("refine.vignetting", "", "true, with equirectangular photos", "false for these")
        logs = torch.tensor(exposures).log() / GAMMA if exposures else torch.zeros(len(cameras))
        self.register_buffer("exif_log_gains", (logs - logs.mean())[:, None].expand(-1, 3).clone(), persistent=False)
        self.register_buffer("optical_axes", cameras.c2w[:, :3, 2].clone(), persistent=False)
        half = cameras.sizes.to(cameras.K) / 2
        corners = torch.maximum(cameras.K[:, :2, 2], 2 * half - cameras.K[:, :2, 2])
        self.corner_tan_squared = float((corners / cameras.K[:, [0, 1], [0, 1]]).square().sum(1).max())
        """Squared tangent of the angle to the axis in the farthest corner."""
        self.log_gains = torch.nn.Parameter(torch.zeros(len(cameras), 3), requires_grad=False)
        self.color_matrices = (
            torch.nn.Parameter(torch.zeros(len(cameras), 3, 4), requires_grad=False) if affine else None
        )
        self.vignetting_coefficients = torch.nn.Parameter(torch.zeros(2), requires_grad=False) if vignetting else None
        self.fix_mean = fix_mean

    @property
    def is_active(self) -> bool:
        return self.log_gains.requires_grad

    @property
    def gains(self) -> Float[Tensor, "V 3"]:
        """Gains of each photo's red, green and blue."""
        return self._subtract_mean(self.log_gains).exp()

    @property
    def corner_brightness(self) -> Float[Tensor, ""] | None:
        """Brightness of the farthest corner relative to the axis; None without vignetting."""
        return None if self.vignetting_coefficients is None else (-self.vignetting_coefficients.sum()).exp()

    def init_from_exif(self) -> None:
        """Initializes the gains from the photos' stated exposures."""
        self.log_gains.data.copy_(self.exif_log_gains)

    def copy_lens(self, other: "ColorCorrection") -> None:
        """Copies another correction's vignetting and freezes it."""
        self.vignetting_coefficients = copy.deepcopy(other.vignetting_coefficients)
        self.corner_tan_squared = other.corner_tan_squared
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
        """Corrects rendered foreground colors to look as in their photos; the background stays.

        Where `truth` is saturated (1), brighter colors are clamped to it.

        Args:
            rgb, opacity: rendered.
            backgrounds: colors behind.
            rays: of the pixels, from the cameras as given.
            views: photo of each ray.
            truth: the photos' pixels.
        """
        if not self.is_active:
            return rgb
        background = (1 - opacity)[:, None] * backgrounds
        foreground = rgb - background
        corrected = foreground * self.gains.index_select(0, views)
        if self.color_matrices is not None:
            matrix, shift = self._subtract_mean(self.color_matrices).index_select(0, views).split((3, 1), dim=2)
            corrected = corrected + (matrix * foreground[:, None]).sum(2) + shift[..., 0] * opacity[:, None]
        if self.vignetting_coefficients is not None:
            corrected = corrected * self.compute_vignetting(rays.directions, views)
        corrected = corrected + background
        return corrected if truth is None else torch.where(truth >= 1, corrected.clamp_max(1), corrected)

    def compute_vignetting(self, directions: Float[Tensor, "R 3"], views: Int[Tensor, "R"]) -> Float[Tensor, "R 1"]:
        """Vignetting factor exp(-a r^2 - b r^4) of ray directions of the cameras as given: 1 on the axis.

        r is the tangent of the angle to the axis, relative to that of the farthest corner.
        """
        assert self.vignetting_coefficients is not None  # checked by the caller
        cosine = (directions * self.optical_axes.index_select(0, views)).sum(1, keepdim=True)
        tan_squared = cosine.square().clamp_min(torch.finfo(cosine.dtype).eps).reciprocal() - 1
        square = tan_squared / self.corner_tan_squared
        first, second = self.vignetting_coefficients
        return torch.exp(-square * (first + square * second))
