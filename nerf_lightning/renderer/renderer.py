"""The volume renderer: asks a field along samples and composites the answers onto a background."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.kernels import composite, volume_weights
from nerf_lightning.kernels.segment_sums import exclusive_sum
from nerf_lightning.model import FieldOutput
from nerf_lightning.renderer.background import Background
from nerf_lightning.renderer.losses import AUTO_VIEW_LOSS_WEIGHT, NEAR_LOSS_END, distortion_loss, near_loss, view_loss
from nerf_lightning.sampler import Samples
from nerf_lightning.utils.option_checks import LossWeight

FieldFn = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N 3"]], FieldOutput | tuple[Tensor, Tensor]]
"""World positions and unit directions -> density (1 / world unit) and rgb in [0, 1], see `FieldOutput`."""


@dataclass(frozen=True)
class RenderOutput:
    """What rays see."""

    rgb: Float[Tensor, "R 3"]
    """Composited onto the background."""
    opacity: Float[Tensor, "R"]
    """In [0, 1]: how much of the background is covered."""
    distance: Float[Tensor, "R"]
    """Along the ray to what covers it, in the scene's unit, times opacity."""
    weights: Float[Tensor, "N"] | None = None
    """How much each sample contributes to its ray, with gradient; None where no loss asks for them."""
    view_residual: Float[Tensor, "N 3"] | None = None
    """See `FieldOutput`."""

    @property
    def depth(self) -> Float[Tensor, "R"]:
        """Distance along the ray of what covers it, in the scene's unit: the mean, and before a background the median; 0 where
        nothing does."""
        return self.distance / self.opacity.clamp_min(1e-6)


def composite_over(pixels: UInt8[Tensor, "R C"], backgrounds: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Photos' pixels in [0, 1], composited onto backgrounds by their straight alpha where C is 4."""
    colours = (pixels / 255).to(backgrounds.dtype)
    if colours.shape[1] == 3:
        return colours
    return torch.lerp(backgrounds, colours[:, :3], colours[:, 3:])


def median_depth(density: Float[Tensor, "N"], opacity: Float[Tensor, "R"], samples: Samples) -> Float[Tensor, "R"]:
    """The distance along each ray where half of its opacity is reached, in the scene's unit; 0 where it has none.

    Density (1 / world unit) is constant within an interval, so that this is exact: the thickness passed is then
    -log(1 - opacity / 2).
    """
    if not len(samples):
        return torch.zeros_like(opacity)
    optical_depth = density * samples.dt
    passed = exclusive_sum(optical_depth, samples.ray, samples.offsets)
    goal = -torch.log1p(-opacity / 2)
    short = torch.nn.functional.pad((passed + optical_depth < goal[samples.ray]).cumsum(0), (1, 0))
    first, last = samples.offsets[:-1], samples.offsets[1:] - 1
    # A sum that falls short by rounding ends at the last sample; a ray without samples reads any, and is told apart below.
    place = torch.minimum(first + short[samples.offsets[1:]] - short[first], last).clamp_min(0)
    share = ((goal - passed[place]) / optical_depth[place].clamp_min(1e-12)).clamp(0, 1)
    return torch.where(opacity > 0, samples.t[place] + (share - 0.5) * samples.dt[place], 0.0)


class VolumeRenderer(torch.nn.Module):
    """Emission-absorption rendering with a stated background (NeRF, Mildenhall et al. 2020, eq. 3), and losses on the weights.

    Args:
        background: "scene" (the scene's own), "black", "white", "random" (a new colour for each training ray, the scene's
            own in evaluation; wants images with alpha), "auto" (random where there is alpha, else the scene's own), or
            three numbers in [0, 1].
        scene_background: the colour "scene" stands for.
        distortion_loss_weight: of `distortion_loss`, against fog.
        near_loss_weight: of `near_loss`, against what stands near the cameras, when training begins; it fades out.
        view_loss_weight: of `view_loss`, on what the direction adds to colours; "auto" takes `AUTO_VIEW_LOSS_WEIGHT`.
        half_size: of the scene's box, world units.
        unbounded: whether the scene has a background, see `Bounds`.
        alpha: whether the photos have alpha.
    """

    def __init__(
        self,
        background: str | list[float] = "scene",
        scene_background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        distortion_loss_weight: LossWeight = 0.0,
        near_loss_weight: LossWeight = 0.0,
        view_loss_weight: LossWeight | Literal["auto"] = 0.0,
        half_size: float = 1.0,
        unbounded: bool = False,
        alpha: bool = False,
    ):
        super().__init__()
        self.background = Background(background, scene_background, alpha)
        self.distortion_loss_weight = distortion_loss_weight
        self.near_loss_weight = near_loss_weight
        self.view_loss_weight = (
            AUTO_VIEW_LOSS_WEIGHT[unbounded] if isinstance(view_loss_weight, str) else view_loss_weight
        )
        self.half_size = half_size
        self.unbounded = unbounded

    @property
    def is_texture_weighted(self) -> bool:
        """Whether `view_loss` asks how textureless photos are: a subject that stands alone is told by its outlines."""
        return self.view_loss_weight > 0 and self.unbounded

    def forward(
        self, rays: Rays, samples: Samples, field: FieldFn, backgrounds: Float[Tensor, "R 3"] | None = None
    ) -> RenderOutput:
        """Renders one colour a ray; `backgrounds` defaults to the renderer's own."""
        if backgrounds is None:
            backgrounds = self.background.sample(len(rays))
        density, rgb, view_residual = FieldOutput(*field(samples.positions(rays), samples.directions(rays)))
        learns = density.requires_grad
        if samples.optical_depth is not None and not learns:
            density = samples.optical_depth / samples.dt
        summed, opacity, distance = composite(density, rgb, samples.t, samples.dt, samples.ray, samples.offsets)
        if self.unbounded and not learns:
            # The mean says little: a hundredth of the weight, left over for the far end, would move it behind the wall.
            distance = opacity * median_depth(density, opacity, samples)
        colour = torch.addcmul(summed, (1 - opacity)[:, None], backgrounds)
        has_losses = self.distortion_loss_weight or self.near_loss_weight or self.view_loss_weight
        if not (self.training and learns and (has_losses or samples.proposals is not None)):
            return RenderOutput(colour, opacity, distance)  # nothing of each sample: a view has many
        weights = volume_weights(density, samples.dt, samples.ray, samples.offsets)
        return RenderOutput(colour, opacity, distance, weights, view_residual)

    def losses(
        self,
        output: RenderOutput,
        samples: Samples,
        progress: float,
        texturelessness: Float[Tensor, "R"] | None = None,
    ) -> dict[str, Float[Tensor, ""]]:
        """Weighted losses on where the weight is and on what the direction adds there, by name.

        Args:
            output: of `forward` in training.
            samples: that were rendered.
            progress: share of the training done.
            texturelessness: of the rays' pixels, for `view_loss`.
        """
        losses: dict[str, Tensor] = {}
        if output.weights is None:
            return losses
        if self.distortion_loss_weight:
            losses["distortion"] = self.distortion_loss_weight * distortion_loss(
                output.weights, samples, self.half_size
            )
        if near_weight := self.near_loss_weight * max(0.0, 1 - progress / NEAR_LOSS_END):
            losses["near"] = near_weight * near_loss(output.weights, samples, self.half_size)
        if self.view_loss_weight and output.view_residual is not None:
            price = view_loss(output.weights, output.view_residual, samples, texturelessness)
            losses["view"] = self.view_loss_weight * price
        return losses
