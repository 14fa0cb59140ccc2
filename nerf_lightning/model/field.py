"""What every field offers, in three dimensions and in two."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, InBounds
from nerf_lightning.errors import InputError


def replace_data(parameter: torch.nn.Parameter, data: Tensor) -> None:
    """Gives a parameter data of another shape. It stays the same parameter, in modules and optimisers."""
    parameter.grad = None
    # Autograd remembers a parameter's shape as long as some graph that used it lives; a change of type makes it forget.
    parameter.data = data.new_empty(0, dtype=torch.float16)
    parameter.data = data


PER_PIXEL = 2.0
"""Cells that the width of a pixel may hold: many views tell more of a place than one, but finer ones are noise."""


class Field(InBounds):
    """A radiance field in world coordinates. Subclasses define `features` and `colour`, or `density` and `forward`.

    Networks work in units of the bounds' half-size; `forward` and `density` convert to 1 / world unit, so that a scene in
    metres and the same scene in millimetres train alike.
    """

    fastest: float = math.inf
    """Adam's learning rate above which training comes apart, as measured by the stability suite; infinite where not known."""
    grown_after: float = 0.0
    """Progress after which the field keeps its size."""

    def __init__(self, bounds: Bounds):
        super().__init__(bounds)
        self.unit_length = bounds.longest
        self.sizing = ""
        """How the field's size follows from the data, in one line; "" where it does not."""

    def grid_sizes(self, coarsest: int, finest: int, size: str) -> tuple[int, int]:
        """Cells along a side of the coarsest and the finest grid: as asked, or for size "auto" no more than photos can show.

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
            f" {min(finest, shown)} of the {finest} asked for"
        )
        return min(coarsest, shown), min(finest, shown)

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        """World positions -> density (1 / half-size, not negative) and what `colour` needs."""
        raise TypeError(f"{type(self).__name__} must define features(positions)")

    def colour(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Features and unit directions -> rgb in [0, 1]."""
        raise TypeError(f"{type(self).__name__} must define colour(features, directions)")

    def grow(self, progress: float) -> list[torch.nn.Parameter]:
        """Called before each training step with the fraction of the budget done; a field may change its size here.

        Returns:
            Parameters whose data was replaced by data of another shape: what an optimiser remembers of them is void.
        """
        return []

    def take(self, smaller: "Field") -> None:
        """Becomes the function that a smaller field of the same kind is, as far as it can, with room for more.

        What is not taken over starts anew; here, that is all.
        """

    def penalty(self) -> Float[Tensor, ""] | None:
        """What training adds to the squared error, if anything."""
        return None

    def prune(self, reached: Bool[Tensor, "G G G"]) -> None:
        """Empties what no position in the reached cells of the unit cube reads: there the field stays what it is."""

    def packed(self) -> dict[str, Tensor]:
        """All that rendering needs, as little of it as there can be: what `unpack` takes."""
        return dict(self.state_dict())

    def unpack(self, packed: dict[str, Tensor]) -> None:
        """Becomes the field that `packed` told of.

        Raises:
            RuntimeError, KeyError: where that was another kind of field, or one of another size.
        """
        self.load_state_dict(packed)

    def density(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """World positions -> density, 1 / world unit."""
        return self.features(positions)[0] / self.unit_length

    def forward(
        self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
        """World positions and unit directions -> density (1 / world unit) and rgb in [0, 1]."""
        density, features = self.features(positions)
        return density / self.unit_length, self.colour(features, directions)


class PictureField(torch.nn.Module):
    """A picture as a function of place: subclasses define `forward`.

    Args:
        size: width and height of the picture in pixels, from which a field takes how fine it must be.
        rate: factor on the learning rate, so that one rate serves fields of every kind.

    Raises:
        InputError: where rate is not above 0.
    """

    grown_after: float = 0.0
    """As of `Field`: it does not grow."""

    def __init__(self, size: tuple[int, int], rate: float = 1.0):
        super().__init__()
        if not rate > 0:
            raise InputError("model.rate", "", str(rate), "above 0")
        self.size = size
        self.rate = rate
        self.sizing = ""
        """How the field's size follows from the picture, in one line; "" where it does not."""

    @property
    def nyquist(self) -> float:
        """The highest frequency that the pixels can show, in cycles over the picture's longer side."""
        return max(self.size) / 2

    def centred(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 2"]:
        """Places with the picture's centre at the origin and its longer side from -1 to 1: pixels stay square."""
        return (2 * uv - 1) * uv.new_tensor([side / max(self.size) for side in self.size])

    def take(self, smaller: "PictureField") -> None:
        """As of `Field`."""

    def packed(self) -> dict[str, Tensor]:
        """As of `Field`."""
        return dict(self.state_dict())

    def unpack(self, packed: dict[str, Tensor]) -> None:
        """As of `Field`."""
        self.load_state_dict(packed)

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        """Places in [0, 1]^2 (x right, y down) -> rgb, in [0, 1] or near it."""
        raise TypeError(f"{type(self).__name__} must define forward(uv)")
