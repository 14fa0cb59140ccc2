"""Volume renderer: evaluates a field at samples and composites the result onto a background."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.kernels import composite, median_depth, volume_weights, weight_losses
from nerf_lightning.model import FieldOutput
from nerf_lightning.renderer.background import Background
from nerf_lightning.sampler import Samples
from nerf_lightning.utils.option_checks import Ge, LossWeight

NEAR_LOSS_END = 0.7
"""Training progress at which the near loss has faded out, so that surfaces it pushed back can recover."""
AUTO_VIEW_LOSS_WEIGHT = {False: 0.01, True: 0.001}
"""Automatic weight of the view loss, by `unbounded`. A bounded subject was often turned before the camera, with the light
fixed; in unbounded scenes view dependence also absorbs exposure changes."""

FieldFn = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N 3"]], FieldOutput | tuple[Tensor, Tensor]]
"""World positions and unit directions -> density (1 / world unit) and rgb in [0, 1], see `FieldOutput`."""


@dataclass(frozen=True)
class RenderOutput:
    """Rendered rays."""

    foreground: Float[Tensor, "R 3"]
    """Color without background."""
    opacity: Float[Tensor, "R"]
    """Accumulated opacity in [0, 1]."""
    distance: Float[Tensor, "R"]
    """Depth times opacity, world units."""
    backgrounds: Float[Tensor, "R 3"] | None = None
    """Color behind each ray; None: black."""
    weights: Float[Tensor, "N"] | None = None
    """Rendering weights with gradient; None if no loss needs them."""
    view_residual: Float[Tensor, "N 3"] | None = None
    """See `FieldOutput`."""

    @property
    def rgb(self) -> Float[Tensor, "R 3"]:
        """Color composited onto the background."""
        if self.backgrounds is None:
            return self.foreground
        return torch.addcmul(self.foreground, (1 - self.opacity)[:, None], self.backgrounds)

    @property
    def depth(self) -> Float[Tensor, "R"]:
        """Depth along the ray, world units: the mean, for unbounded scenes the median; 0 where opacity is 0."""
        return self.distance / self.opacity.clamp_min(1e-6)


def scale_gradients(
    density: Float[Tensor, "N"], rgb: Float[Tensor, "N 3"], t: Float[Tensor, "N"], full_distance: float
) -> None:
    """Lets gradients of density and color arrive times min(1, t / full_distance)^2 (Philip and Deschaintre 2023).

    A volume near a camera is crossed by more of its rays than one far away, by the inverse square of the distance. Without
    scaling it learns first, and a photo is explained by floaters before its camera.

    Args:
        density, rgb: of the field at each sample.
        t: distance of each sample from its camera, world units.
        full_distance: distance from which gradients stay as they are, world units.
    """
    scale = (t / full_distance).clamp_max_(1).square_()
    for output, factor in ((density, scale), (rgb, scale[:, None])):
        if output.requires_grad:
            output.register_hook(factor.mul)


class VolumeRenderer(torch.nn.Module):
    """Volume rendering (NeRF, Mildenhall et al. 2020, eq. 3) over a background, and losses on the rendering weights.

    Args:
        background: "scene" (the scene's color), "black", "white", "random" (in training the mean over random colors, "scene" in
            evaluation; needs images with alpha), "auto" ("random" with alpha, else "scene"), or three numbers in [0, 1].
        scene_background: the color of "scene".
        distortion_loss_weight: weight of `distortion_loss`, against fog.
        near_loss_weight: initial weight of `near_loss`, against density near the cameras; it fades out.
        gradient_scaling_distance: distance below which `scale_gradients` applies, against floaters, in half-sizes; 0: off.
        view_loss_weight: weight of `view_loss`, on view-dependent color; "auto": `AUTO_VIEW_LOSS_WEIGHT`.
        half_size: half-size of the scene's box or core, world units.
        unbounded: see `Bounds`.
        alpha: whether the photos have alpha.
    """

    def __init__(
        self,
        background: str | list[float] = "auto",
        scene_background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        distortion_loss_weight: LossWeight = 0.0,
        near_loss_weight: LossWeight = 0.0,
        gradient_scaling_distance: Annotated[float, Ge(0)] = 0.0,
        view_loss_weight: LossWeight | Literal["auto"] = 0.0,
        half_size: float = 1.0,
        unbounded: bool = False,
        alpha: bool = False,
    ):
        super().__init__()
        self.background = Background(background, scene_background, alpha)
        self.distortion_loss_weight = distortion_loss_weight
        self.near_loss_weight = near_loss_weight
        self.full_gradient_distance = gradient_scaling_distance * half_size
        auto_weight = AUTO_VIEW_LOSS_WEIGHT[unbounded]
        self.view_loss_weight = auto_weight if isinstance(view_loss_weight, str) else view_loss_weight
        self.half_size = half_size
        self.unbounded = unbounded

    @property
    def is_texture_weighted(self) -> bool:
        """Whether `view_loss` needs the photos' texturelessness: outlines suffice to constrain a bounded subject."""
        return self.view_loss_weight > 0 and self.unbounded

    def forward(
        self, rays: Rays, samples: Samples, field: FieldFn, backgrounds: Float[Tensor, "R 3"] | None = None
    ) -> RenderOutput:
        """Renders rays over `backgrounds`, by default the renderer's background."""
        if backgrounds is None:
            backgrounds = self.background.expand(len(rays))
        density, rgb, view_residual = FieldOutput(*field(samples.positions(rays), samples.directions(rays)))
        has_gradient = density.requires_grad
        if has_gradient and self.full_gradient_distance:
            scale_gradients(density, rgb, samples.t, self.full_gradient_distance)
        if samples.optical_depth is not None and not has_gradient:
            density = samples.optical_depth / samples.dt
        foreground, opacity, distance = composite(density, rgb, *samples.packed)
        if self.unbounded and not has_gradient:
            # Median for unbounded scenes: 1 % of stray weight at the far plane would dominate the mean.
            distance = opacity * median_depth(density, opacity, samples.packed)
        has_losses = self.distortion_loss_weight or self.near_loss_weight or self.view_loss_weight
        if not (self.training and has_gradient and (has_losses or samples.proposals is not None)):
            return RenderOutput(foreground, opacity, distance, backgrounds)  # a full view has too many samples to keep
        per_ray = None if samples.proposals is None else samples.proposals.edges.shape[1] - 1
        weights = volume_weights(density, samples.dt, samples.ray, samples.offsets, per_ray)
        return RenderOutput(foreground, opacity, distance, backgrounds, weights, view_residual)

    def losses(
        self, output: RenderOutput, samples: Samples, progress: float, texturelessness: Float[Tensor, "R"] | None = None
    ) -> dict[str, Float[Tensor, ""]]:
        """Weighted regularization losses by name.

        Args:
            output: output of `forward` in training.
            samples: the rendered samples.
            progress: training progress in [0, 1].
            texturelessness: texturelessness of each ray's pixel, for `view_loss`.
        """
        if output.weights is None:
            return {}
        near_weight = self.near_loss_weight * max(0.0, 1 - progress / NEAR_LOSS_END)
        factors = self.distortion_loss_weight, near_weight, self.view_loss_weight
        inputs = output.weights, output.view_residual, samples.packed, self.half_size
        return weight_losses(*inputs, factors, texturelessness)
