"""Background colors of rays that hit nothing."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.errors import InputError

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
SCENE_CHOICES = ("scene", "random", "auto")
RANDOM_MEAN, RANDOM_VARIANCE = 0.5, 1 / 12
"""Of a channel of a uniformly random color, see `photometric_loss`."""


class Background(torch.nn.Module):
    """Constant background color, or in training the mean of random ones.

    Args:
        choice: see `VolumeRenderer`.
        scene_color: the color of "scene".
        has_alpha: whether the photos have alpha.

    Raises:
        InputError: for any other choice.
    """

    color: Tensor
    training_color: Tensor

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
        training_color = [RANDOM_MEAN] * 3 if self.is_random else color
        self.register_buffer("color", torch.tensor(color), persistent=False)
        self.register_buffer("training_color", torch.tensor(training_color), persistent=False)

    @property
    def variance(self) -> float:
        """Variance of a channel in training."""
        return RANDOM_VARIANCE if self.is_random else 0.0

    def expand(self, count: int, is_training: bool = False) -> Float[Tensor, "R 3"]:
        """Background colors of `count` rays; in training the mean of random ones."""
        return (self.training_color if is_training else self.color).expand(count, 3)
