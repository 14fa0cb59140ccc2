"""The volume renderer: asks a field along samples and composites the answers onto a background."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Generator, Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import composite, volume_weights
from nerf_lightning.renderer.depth import median_depth
from nerf_lightning.renderer.penalties import NEAR_UNTIL, SUITED_VIEW_WEIGHT, distortion_loss, near_loss, view_loss
from nerf_lightning.sampler import Samples

FieldFn = Callable[
    [Float[Tensor, "N 3"], Float[Tensor, "N 3"]],
    tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]
    | tuple[Float[Tensor, "N"], Float[Tensor, "N 3"], Float[Tensor, "N 3"] | None],
]
"""World positions and unit directions -> density (1 / world unit) and rgb in [0, 1]; a third value is the view part of
`Field.with_view_part`."""

NAMED = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class Rendered:
    """What a ray sees."""

    rgb: Float[Tensor, "R 3"]
    """Composited onto the background."""
    opacity: Float[Tensor, "R"]
    """In [0, 1]: how much of the background is covered."""
    distance: Float[Tensor, "R"]
    """Along the ray to what covers it, in the scene's unit, times opacity."""
    penalty: Float[Tensor, ""] | None = None
    """What training adds to its loss, where the renderer asks for that."""
    weights: Float[Tensor, "N"] | None = None
    """How much each sample contributed, where the sampler learns from that; without gradient."""

    @property
    def depth(self) -> Float[Tensor, "R"]:
        """Distance along the ray of what covers it, in the scene's unit: the mean, and before a background the median; 0 where
        nothing does."""
        return self.distance / self.opacity.clamp_min(1e-6)


def over(pixels: UInt8[Tensor, "R C"], backgrounds: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Photos' pixels in [0, 1], composited onto backgrounds by their straight alpha where C is 4."""
    colours = (pixels / 255).to(backgrounds.dtype)
    if colours.shape[1] == 3:
        return colours
    return torch.lerp(backgrounds, colours[:, :3], colours[:, 3:])


class VolumeRenderer(torch.nn.Module):
    """Emission-absorption rendering with a stated background.

    Args:
        background: "scene" (the scene's own), "black", "white", "random" (a new colour for each training ray, the scene's
            own in evaluation; wants images with alpha), "suited" (random where there is alpha, else the scene's own), or
            three numbers in [0, 1].
        scene_background: the colour "scene" stands for.
        distortion_loss_weight: of the penalty on fog in training, see `distortion_loss`; 0 does without.
        near_loss_weight: of the penalty on what stands near the cameras, see `near_loss`, when training begins; it fades out.
        view_loss_weight: of the penalty on what the direction adds to colours, see `view_loss`; "suited" takes
            `SUITED_VIEW_WEIGHT`.
        half_size: of the scene's box, world units.
        unbounded: whether the scene has a background, see `Bounds`.
        alpha: whether the photos have alpha.

    Raises:
        InputError: on any other background, or a negative weight.
    """

    colour: Tensor
    near_weight: Tensor

    def __init__(
        self,
        background: str | list[float] = "scene",
        scene_background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        distortion_loss_weight: float = 0.0,
        near_loss_weight: float = 0.0,
        view_loss_weight: float | str = 0.0,
        half_size: float = 1.0,
        unbounded: bool = False,
        alpha: bool = False,
    ):
        super().__init__()
        if isinstance(view_loss_weight, str):
            if view_loss_weight != "suited":
                raise InputError("renderer.view_loss_weight", "", repr(view_loss_weight), "suited, or 0 or more")
            view_loss_weight = SUITED_VIEW_WEIGHT[unbounded]
        penalties = {"distortion": distortion_loss_weight, "near": near_loss_weight, "view": view_loss_weight}
        for name, weight in penalties.items():
            if weight < 0:
                raise InputError(f"renderer.{name}_loss_weight", "", str(weight), "0 or more")
        self.distortion_loss_weight = distortion_loss_weight
        self.near_loss_weight = near_loss_weight
        self.view_loss_weight = view_loss_weight
        self.penalises = any(penalties.values())
        self.half_size = half_size
        self.unbounded = unbounded
        self.random = background == "random" or (background == "suited" and alpha)
        colour: Sequence[float]
        if background in ("scene", "random", "suited"):
            colour = scene_background
        elif isinstance(background, str):
            if background not in NAMED:
                raise InputError(
                    "renderer.background",
                    "",
                    repr(background),
                    "scene, black, white, random, suited or three numbers in [0, 1]",
                )
            colour = NAMED[background]
        else:
            colour = tuple(float(c) for c in background)
            if len(colour) != 3 or not all(0 <= c <= 1 for c in colour):
                raise InputError("renderer.background", "", str(list(colour)), "three numbers in [0, 1]")
        self.register_buffer("colour", torch.tensor(colour), persistent=False)
        # A tensor, since compiled steps are compiled again for every new number.
        self.register_buffer("near_weight", torch.tensor(float(near_loss_weight)), persistent=False)

    @property
    def prices_plain(self) -> bool:
        """Whether `view_loss` wants to know how plain photos are: a subject that stands alone is told by its outlines."""
        return self.view_loss_weight > 0 and self.unbounded

    def fade(self, progress: float) -> None:
        """Called before each training step with the fraction of the budget done."""
        self.near_weight.fill_(self.near_loss_weight * max(0.0, 1 - progress / NEAR_UNTIL))

    def backgrounds(self, rays: int, generator: Generator | None = None) -> Float[Tensor, "R 3"]:
        """The colour behind each ray; random only in training, when a generator is given."""
        if self.random and generator is not None:
            return torch.rand(rays, 3, generator=generator, device=self.colour.device)
        return self.colour.expand(rays, 3)

    def forward(
        self,
        rays: Rays,
        samples: Samples,
        field: FieldFn,
        backgrounds: Float[Tensor, "R 3"] | None = None,
        plain: Float[Tensor, "R"] | None = None,
    ) -> Rendered:
        """Renders one colour a ray; `backgrounds` defaults to the renderer's own, `plain` is for `view_loss`."""
        if backgrounds is None:
            backgrounds = self.backgrounds(len(rays))
        density, rgb, *view_part = field(samples.positions(rays), samples.directions(rays))
        if samples.thickness is not None and not density.requires_grad:
            density = samples.thickness / samples.dt
        summed, opacity, distance = composite(density, rgb, samples.t, samples.dt, samples.ray, samples.offsets)
        if self.unbounded and not density.requires_grad:
            # The mean says little: a hundredth of the weight, left over for the far end, would move it behind the wall.
            distance = opacity * median_depth(density, opacity, samples)
        colour = torch.addcmul(summed, (1 - opacity)[:, None], backgrounds)
        penalty, weights = None, None
        if self.training and density.requires_grad and self.penalises:
            weights = volume_weights(density, samples.dt, samples.ray, samples.offsets)
            penalty = self.penalty(weights, samples, view_part[0] if view_part else None, plain)
        elif samples.proposals is not None:
            weights = volume_weights(density.detach(), samples.dt, samples.ray, samples.offsets)
        learned = None if samples.proposals is None or weights is None else weights.detach()
        return Rendered(colour, opacity, distance, penalty, learned)

    def penalty(
        self,
        weights: Float[Tensor, "N"],
        samples: Samples,
        view_part: Float[Tensor, "N 3"] | None,
        plain: Float[Tensor, "R"] | None,
    ) -> Float[Tensor, ""]:
        """What training adds to its loss for where the weight is, and for what the direction adds there."""
        total = weights.new_zeros(())
        if self.distortion_loss_weight:
            total = total + self.distortion_loss_weight * distortion_loss(weights, samples, self.half_size)
        if self.near_loss_weight:
            total = total + self.near_weight * near_loss(weights, samples, self.half_size)
        if self.view_loss_weight and view_part is not None:
            total = total + self.view_loss_weight * view_loss(weights, view_part, samples, plain)
        return total
