"""Base classes of radiance fields and of picture fields."""

import math
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import BoundedModule, Bounds
from nerf_lightning.model.growth import ResolutionSchedule

BYTES_PER_PARAMETER = 16
"""Training memory: parameter, gradient and Adam's two moments, in single precision."""
MAX_CELLS_PER_PIXEL = 2.0
"""Grid cells per pixel along a side: many views resolve more than one view does, but finer cells fit noise."""
Size = Literal["auto", "fixed"]


class FieldOutput(NamedTuple):
    """Output of a radiance field for N positions and viewing directions."""

    density: Float[Tensor, "N"]
    """1 / world unit, not negative."""
    rgb: Float[Tensor, "N 3"]
    """In [0, 1]."""
    view_residual: Float[Tensor, "N 3"] | None = None
    """View-dependent part of the color logits (SNeRG, Hedman et al. 2021); None if the field does not separate it."""


class BaseField(torch.nn.Module):
    """Interface shared by radiance fields and picture fields."""

    max_lr: float = math.inf
    """Maximum stable learning rate of Adam, measured by the stability suite; infinite if unknown."""
    growth: ResolutionSchedule | None = None
    """Upsampling schedule; None for a field of constant resolution."""
    size_message: str = ""
    """Log line that explains how the data limit the field's size; "" if they do not."""

    def max_num_parameters(self) -> int:
        """Number of parameters at the final resolution, as far as it is known in advance."""
        return sum(parameter.numel() for parameter in self.parameters())

    @property
    def training_bytes(self) -> int:
        """Minimum training memory at the final resolution."""
        return BYTES_PER_PARAMETER * self.max_num_parameters()

    def warm_start_from(self, smaller: Any) -> None:
        """Copies the function of a smaller field of the same kind; what cannot be copied keeps its random initialization."""

    def export_state(self) -> dict[str, Tensor]:
        """State that rendering needs, for `import_state`."""
        return dict(self.state_dict())

    def import_state(self, state: dict[str, Tensor]) -> None:
        """Restores what `export_state` returned.

        Raises:
            RuntimeError, KeyError: if it came from another kind or size of field.
        """
        self.load_state_dict(state)


class Field(BoundedModule, BaseField):
    """A radiance field in world coordinates. Subclasses define `features` and `color`, or `density` and `forward`.

    Networks work in units of the bounds' half-size; `forward` and `density` convert to 1 / world unit, so that training does
    not depend on the scene's unit of length. A field with a `growth` schedule defines `stage` and `upsample`.
    """

    stage: int = 0
    """Current stage of `growth`."""
    cpu_chunks: int = 1
    """Samples evaluated together on a CPU without gradient, in multiples of `Sampler.chunk`."""

    @property
    def resolution_scale(self) -> float:
        """Current resolution relative to the default; the samplers' steps and the batch size scale with it."""
        return 1.0

    def __init__(self, bounds: Bounds):
        super().__init__(bounds)
        self.unit_length = bounds.max_half_size

    def limit_resolutions(self, base_resolution: int, max_resolution: int, size: Size) -> tuple[int, int]:
        """Returns both resolutions, with "auto" limited to `MAX_CELLS_PER_PIXEL` of the photos."""
        pixels = self.bounds.unit_cube_pixels
        if size == "fixed" or pixels == math.inf:
            return base_resolution, max_resolution
        max_cells = max(math.ceil(MAX_CELLS_PER_PIXEL * pixels), 2)
        self.size_message = (
            f"the content is {pixels:.0f} pixels wide in the photos, which show {max_cells} cells a side at most:"
            f" {min(max_resolution, max_cells)} of {max_resolution} wanted"
        )
        return min(base_resolution, max_cells), min(max_resolution, max_cells)

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        """World positions -> density (1 / half-size, not negative) and the features that `color` reads."""
        raise TypeError(f"{type(self).__name__} must define features(positions)")

    def color(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Features and unit directions -> rgb in [0, 1]."""
        raise TypeError(f"{type(self).__name__} must define color(features, directions)")

    def upsample(self, stage: int) -> list[torch.nn.Parameter]:
        """Upsamples to the resolution of a later stage of `growth`, preserving the function as far as possible.

        Returns:
            Parameters whose shape changed: the optimizer's state for them must be reset.
        """
        raise TypeError(f"{type(self).__name__} must define upsample(stage)")

    def losses(self) -> dict[str, Float[Tensor, ""]]:
        """Regularization losses on the parameters, by name."""
        return {}

    def prune(self, visible_cells: Bool[Tensor, "G G G"]) -> None:
        """Clears parameters that no position in the visible cells of the unit cube reads; the field there is unchanged."""

    def density(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """World positions -> density, 1 / world unit."""
        return self.features(positions)[0] / self.unit_length

    def forward(self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> FieldOutput:
        """World positions and unit directions -> density and color."""
        density, features = self.features(positions)
        return FieldOutput(density / self.unit_length, self.color(features, directions))


class PictureField(BaseField):
    """A picture as a function of position: subclasses define `forward`.

    Args:
        size: width and height of the picture in pixels, which determine the field's resolution.
        lr_scale: factor on the learning rate, above 0, so that one configured rate works for all fields.
    """

    def __init__(self, size: tuple[int, int], lr_scale: float = 1.0):
        super().__init__()
        self.size = size
        self.lr_scale = lr_scale

    @property
    def nyquist(self) -> float:
        """Nyquist frequency of the pixels, in cycles over the picture's longer side."""
        return max(self.size) / 2

    def centered(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 2"]:
        """Positions with the picture's center at the origin and its longer side from -1 to 1: pixels stay square."""
        return (2 * uv - 1) * uv.new_tensor([side / max(self.size) for side in self.size])

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        """Positions in [0, 1]^2 (x right, y down) -> rgb, in [0, 1] or near it."""
        raise TypeError(f"{type(self).__name__} must define forward(uv)")
