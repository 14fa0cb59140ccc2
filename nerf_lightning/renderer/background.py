"""Background colors of rays that hit nothing."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from nerf_lightning.errors import InputError

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
SCENE_CHOICES = ("scene", "random", "auto")


class Background(torch.nn.Module):
    """Constant background color, or in training a random one per ray.

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

    def sample(self, count: int, generator: Generator | None = None) -> Float[Tensor, "R 3"]:
        """Background colors of `count` rays; random only with a generator (training)."""
        if self.is_random and generator is not None:
            return torch.rand(count, 3, generator=generator, device=self.color.device)
        return self.color.expand(count, 3)
