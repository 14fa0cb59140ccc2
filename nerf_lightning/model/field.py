"""What every field offers, in three dimensions and in two."""

import math
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import BoundedModule, Bounds
from nerf_lightning.model.growth import ResolutionSchedule

BYTES_PER_PARAMETER = 16
"""In training: itself, its gradient and Adam's two moments, in single precision."""
MAX_CELLS_PER_PIXEL = 2.0
"""Along a side: many views together show more than one does, but finer cells hold noise."""
Size = Literal["auto", "fixed"]


class FieldOutput(NamedTuple):
    """What a radiance field says of positions seen from directions."""

    density: Float[Tensor, "N"]
    """1 / world unit, not negative."""
    rgb: Float[Tensor, "N 3"]
    """In [0, 1]."""
    view_residual: Float[Tensor, "N 3"] | None = None
    """What the direction adds to the logits of the colour (SNeRG, Hedman et al. 2021); None where the field cannot tell."""


class BaseField(torch.nn.Module):
    """What fields in two and in three dimensions have in common."""

    max_lr: float = math.inf
    """Adam's learning rate above which training diverges, as the stability suite measured it; infinite if unknown."""
    growth: ResolutionSchedule | None = None
    """Of a field that is upsampled during training."""
    size_message: str = ""
    """One line on how the field's size follows from the data; "" if it does not."""

    def max_num_parameters(self) -> int:
        """How many numbers it will learn at its full size, as far as that is known beforehand."""
        return sum(parameter.numel() for parameter in self.parameters())

    @property
    def training_bytes(self) -> int:
        """Memory that it takes in training at least, at its largest."""
        return BYTES_PER_PARAMETER * self.max_num_parameters()

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


class Field(BoundedModule, BaseField):
    """A radiance field in world coordinates. Subclasses define `features` and `colour`, or `density` and `forward`.

    Networks work in units of the bounds' half-size; `forward` and `density` convert to 1 / world unit, so that a scene in
    metres and the same scene in millimetres train alike. A field that grows has a `growth` and defines `stage` and `upsample`.
    """

    stage: int = 0
    """Of `growth`."""

    @property
    def resolution_scale(self) -> float:
        """How much finer than usual large photos have made it by now: it wants so many more steps along a ray, and samples a
        step."""
        return 1.0

    def __init__(self, bounds: Bounds):
        super().__init__(bounds)
        self.unit_length = bounds.max_half_size

    def limit_resolutions(self, base_resolution: int, max_resolution: int, size: Size) -> tuple[int, int]:
        """Cells along a side of the coarsest and the finest grid: as given, or with "auto" no more than the photos can show."""
        across = self.bounds.unit_cube_pixels
        if size == "fixed" or across == math.inf:
            return base_resolution, max_resolution
        shown = max(math.ceil(MAX_CELLS_PER_PIXEL * across), 2)
        self.size_message = (
            f"the content is {across:.0f} pixels wide in the photos, which show {shown} cells a side at most:"
            f" {min(max_resolution, shown)} of {max_resolution} wanted"
        )
        return min(base_resolution, shown), min(max_resolution, shown)

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        """World positions -> density (1 / half-size, not negative) and what `colour` needs."""
        raise TypeError(f"{type(self).__name__} must define features(positions)")

    def colour(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Features and unit directions -> rgb in [0, 1]."""
        raise TypeError(f"{type(self).__name__} must define colour(features, directions)")

    def upsample(self, stage: int) -> list[torch.nn.Parameter]:
        """Takes the resolution of a later stage of its `growth`; the function stays the same as far as it can.

        Returns:
            Parameters whose data now has another shape: an optimiser must forget its state for them.
        """
        raise TypeError(f"{type(self).__name__} must define upsample(stage)")

    def losses(self) -> dict[str, Float[Tensor, ""]]:
        """Regularization losses on what the field holds, by name."""
        return {}

    def prune(self, find_visible_cells: Bool[Tensor, "G G G"]) -> None:
        """Empties what no position in the reached cells of the unit cube reads; in those cells the field does not change."""

    def density(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """World positions -> density, 1 / world unit."""
        return self.features(positions)[0] / self.unit_length

    def forward(self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> FieldOutput:
        """World positions and unit directions -> density and colour."""
        density, features = self.features(positions)
        return FieldOutput(density / self.unit_length, self.colour(features, directions))


class PictureField(BaseField):
    """A picture as a function of position: subclasses define `forward`.

    Args:
        size: width and height of the picture in pixels, which decide how fine the field is.
        lr_scale: factor on the learning rate, above 0, so that one rate suits every kind of field.
    """

    def __init__(self, size: tuple[int, int], lr_scale: float = 1.0):
        super().__init__()
        self.size = size
        self.lr_scale = lr_scale

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
