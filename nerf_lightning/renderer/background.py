"""Background colors of rays that hit nothing."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerf_lightning.errors import InputError
from nerf_lightning.kernels import mean_squared_error

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
SCENE_CHOICES = ("scene", "random", "auto")
RANDOM_MEAN, RANDOM_VARIANCE = 0.5, 1 / 12
"""Of a channel of a uniformly random color."""


class Background(torch.nn.Module):
    """Constant background color, or in training the mean of random ones, see `opacity_loss`.

    Args:
        choice: see `VolumeRenderer`.
        scene_color: the color of "scene".
        has_alpha: whether the photos have alpha.

    Raises:
        InputError: for any other choice.
    """

    color: Tensor

    def __init__(self, choice: str | list[float], scene_color: tuple[float, float, float], has_alpha: bool):
        super().__init__()
        self.is_random = choice == "random" or (choice == "auto" and has_alpha)
        color: Sequence[float]
        if isinstance(choice, str):
            color = scene_color if choice in SCENE_CHOICES else COLORS.get(choice, ())
        else:
            color = choice
        if len(color) != 3 or not all(0 <= c <= 1 for c in color):
            expected = f"{', '.join([*SCENE_CHOICES, *COLORS])} or three numbers in [0, 1]"
            raise InputError("renderer.background", "", repr(choice), expected)
        self.register_buffer("color", torch.tensor(color), persistent=False)

    def expand(self, count: int, is_training: bool = False) -> Float[Tensor, "R 3"]:
        """Background colors of `count` rays; in training the mean of random ones."""
        if self.is_random and is_training:
            return torch.full((count, 3), RANDOM_MEAN, device=self.color.device)
        return self.color.expand(count, 3)


def opacity_loss(
    opacity: Float[Tensor, "R"],
    pixels: UInt8[Tensor, "R 4"],
    weights: Float[Tensor, "R"] | None,
    complete: Bool[Tensor, "R"] | None,
) -> tuple[Float[Tensor, ""], Float[Tensor, "R"]]:
    """What random background colors add to the photometric loss on their mean; arguments as in `photometric_loss`.

    A channel's error on a background b is e + (alpha - opacity) * (b - mean): its expected square adds the variance of b times
    the squared error of the opacity. This mean over all colors has less noise than one color per ray.
    """
    loss, squared_errors = mean_squared_error(opacity[:, None], pixels[:, 3:] / 255, weights, complete)
    return RANDOM_VARIANCE * loss, RANDOM_VARIANCE * squared_errors
