"""What every field offers, in three dimensions and in two."""

import math
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, InBounds
from nerf_lightning.errors import InputError


def replace_data(parameter: torch.nn.Parameter, data: Tensor) -> None:
    """Gives a parameter data of another shape. Modules and optimisers keep the same parameter."""
    parameter.grad = None
    # Autograd remembers a parameter's shape while a graph that used it lives; a change of type makes it forget.
    parameter.data = data.new_empty(0, dtype=torch.float16)
    parameter.data = data


LEARNED = 16
"""Bytes of a number that is learned: itself, its gradient and Adam's two moments, in single precision."""


class AnyField(torch.nn.Module):
    """What fields in two and in three dimensions have in common."""

    grown_after: float = 0.0
    """Fraction of the budget after which the field keeps its size."""
    sizing: str = ""
    """One line on how the field's size follows from the data; "" if it does not."""

    @property
    def values(self) -> int:
        """How many numbers it learns at its present size."""
        return sum(parameter.numel() for parameter in self.parameters())

    def values_grown(self) -> int:
        """How many it will learn at its full size, as far as that is known beforehand."""
        return self.values

    @property
    def training_bytes(self) -> int:
        """Memory that it takes in training at least, at its largest."""
        return LEARNED * self.values_grown()

    def warm_start_from(self, smaller: Any) -> None:
        """Copies the function of a smaller field of the same kind, as far as possible, leaving the rest free to learn.

        What cannot be copied starts fresh; here, that is everything.
        """

    def export_state(self) -> dict[str, Tensor]:
        """The least that rendering needs, for `import_state`."""
        return dict(self.state_dict())

    def import_state(self, state: dict[str, Tensor]) -> None:
        """Restores what `export_state` returned.

        Raises:
            RuntimeError, KeyError: if it came from another kind or size of field.
        """
        self.load_state_dict(state)


PER_PIXEL = 2.0
"""Most cells per pixel width: many views together show more than one does, but finer cells hold noise."""


class Field(InBounds, AnyField):
    """A radiance field in world coordinates. Subclasses define `features` and `colour`, or `density` and `forward`.

    Networks work in units of the bounds' half-size; `forward` and `density` convert to 1 / world unit, so that a scene in
    metres and the same scene in millimetres train alike.
    """

    fastest: float = math.inf
    """Adam's learning rate above which training diverges, as the stability suite measured it; infinite if unknown."""
    growing_steps: int = 0
    """Steps before which it does not have its last size, whatever the budget: the smaller ones need them."""
    growing_steps_most: float = math.inf
    """Steps after which it has its last size, whatever the budget: the smaller ones have learned what they can by then."""

    @property
    def finer(self) -> float:
        """How much finer than usual large photos have made it by now: it wants so many more steps along a ray, and samples a
        step."""
        return 1.0

    def __init__(self, bounds: Bounds):
        super().__init__(bounds)
        self.unit_length = bounds.longest

    def grid_sizes(self, coarsest: int, finest: int, size: str) -> tuple[int, int]:
        """Cells along a side of the coarsest and the finest grid: as given, or with "auto" no more than the photos can show.

        Raises:
            InputError: where coarsest > finest, or for another size than "auto" and "fixed".
        """
        if not 0 < coarsest <= finest:
            raise InputError("model.coarsest", "", f"{coarsest} with model.finest={finest}", "0 < coarsest <= finest")
        if size not in ("auto", "fixed"):
            raise InputError("model.size", "", repr(size), "auto or fixed")
        across = self.bounds.pixels_across
        if size == "fixed" or across == math.inf:
            return coarsest, finest
        shown = max(math.ceil(PER_PIXEL * across), 2)
        self.sizing = (
            f"the content is {across:.0f} pixels wide in the photos, which show {shown} cells a side at most:"
            f" {min(finest, shown)} of {finest} wanted"
        )
        return min(coarsest, shown), min(finest, shown)

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        """World positions -> density (1 / half-size, not negative) and what `colour` needs."""
        raise TypeError(f"{type(self).__name__} must define features(positions)")

    def colour(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Features and unit directions -> rgb in [0, 1]."""
        raise TypeError(f"{type(self).__name__} must define colour(features, directions)")

    def grows_at(self, progress: float) -> bool:
        """Whether `grow` would change its size."""
        return False

    def grow(self, progress: float) -> list[torch.nn.Parameter]:
        """Called before each training step with the fraction of the budget done; a field may change its size here.

        Returns:
            Parameters whose data now has another shape: an optimiser must forget its state for them.
        """
        return []

    def penalty(self) -> Float[Tensor, ""] | None:
        """What training adds to the squared error, or None."""
        return None

    def prune(self, reached: Bool[Tensor, "G G G"]) -> None:
        """Empties what no position in the reached cells of the unit cube reads; in those cells the field does not change."""

    def density(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """World positions -> density, 1 / world unit."""
        return self.features(positions)[0] / self.unit_length

    def forward(
        self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
        """World positions and unit directions -> density (1 / world unit) and rgb in [0, 1]."""
        density, features = self.features(positions)
        return density / self.unit_length, self.colour(features, directions)

    def with_view_part(
        self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"], Float[Tensor, "N 3"] | None]:
        """As `forward`, and what the direction adds to the logits of the colour; None where the field cannot tell."""
        return *self(positions, directions), None


class PictureField(AnyField):
    """A picture as a function of position: subclasses define `forward`.

    Args:
        size: width and height of the picture in pixels, which decide how fine the field is.
        rate: factor on the learning rate, so that one rate suits every kind of field.

    Raises:
        InputError: where rate is not above 0.
    """

    def __init__(self, size: tuple[int, int], rate: float = 1.0):
        super().__init__()
        if not rate > 0:
            raise InputError("model.rate", "", str(rate), "above 0")
        self.size = size
        self.rate = rate

    @property
    def nyquist(self) -> float:
        """The Nyquist frequency of the pixels, in cycles over the picture's longer side."""
        return max(self.size) / 2

    def centred(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 2"]:
        """Positions with the picture's centre at the origin and its longer side from -1 to 1: pixels stay square."""
        return (2 * uv - 1) * uv.new_tensor([side / max(self.size) for side in self.size])

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        """Positions in [0, 1]^2 (x right, y down) -> rgb, in [0, 1] or near it."""
        raise TypeError(f"{type(self).__name__} must define forward(uv)")
