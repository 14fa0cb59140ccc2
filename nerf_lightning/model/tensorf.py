"""TensoRF (Chen et al. 2022): vector-matrix decomposed volumes and the radiance field on them."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import mlp, plane_line_sum, plane_line_sum_and_products
from nerf_lightning.kernels.vector_matrix import PLANE_AXES
from nerf_lightning.model.field import Field, FieldOutput, Size
from nerf_lightning.model.growth import ResolutionSchedule, replace_data
from nerf_lightning.model.hashgrid import level_resolutions
from nerf_lightning.model.layers.activation import Activation, density_activation
from nerf_lightning.model.layers.encoding import encode_directions, num_sh_bases
from nerf_lightning.model.layers.grid_masks import vertices_of_cells
from nerf_lightning.model.layers.networks import build_layers, layer_parameters, linear_layers, widen
from nerf_lightning.utils.option_checks import Count, Fraction, GridSize, Layers, SHDegree

DEFAULT_MAX_RESOLUTION = 160
"""Final cells along a side for photos of usual size."""
DEFAULT_WIDTH = 32
"""Neurons of the hidden layer for photos of usual size."""
MIN_STEPS_PER_STAGE, MAX_STEPS_PER_STAGE = 80, 1000
"""Minimum and maximum number of steps of each resolution stage before the last."""


class VectorMatrix(torch.nn.Module):
    """Trainable planes times lines over the unit cube: TensoRF's vector-matrix decomposition (eq. 3).

    Args:
        cells: cells along each side.
        components: channels of each of the three planes and lines.
    """

    INIT_STD = 0.1  # as in the authors' code

    def __init__(self, cells: int, components: int):
        super().__init__()
        side = cells + 1
        self.planes = torch.nn.Parameter(self.INIT_STD * torch.randn(3, side, side, components))
        self.lines = torch.nn.Parameter(self.INIT_STD * torch.randn(3, side, components))

    @property
    def cells(self) -> int:
        """Current cells along each side."""
        return self.lines.shape[1] - 1

    @torch.no_grad()
    def resize(self, cells: int) -> None:
        """Resamples planes and lines; exact if the new grid contains all old vertices."""
        planes = self.planes.permute(0, 3, 1, 2)
        lines = self.lines.transpose(1, 2)
        planes = interpolate(planes, (cells + 1, cells + 1), mode="bilinear", align_corners=True)
        lines = interpolate(lines, cells + 1, mode="linear", align_corners=True)
        replace_data(self.planes, planes.permute(0, 2, 3, 1).contiguous())
        replace_data(self.lines, lines.transpose(1, 2).contiguous())

    @torch.no_grad()
    def warm_start_from(self, smaller: "VectorMatrix", zero_init: bool) -> None:
        """Copies the components and resolution of a volume with at most the same number of components.

        Args:
            smaller: the volume to copy.
            zero_init: whether the lines of new components start at zero.
        """
        new = self.lines.shape[2] - smaller.lines.shape[2]
        planes, lines = (self.INIT_STD * torch.randn(*old.shape[:-1], new) for old in (smaller.planes, smaller.lines))
        if zero_init:
            lines.zero_()
        replace_data(self.planes, torch.cat([smaller.planes, planes], dim=3))
        replace_data(self.lines, torch.cat([smaller.lines, lines], dim=2))

    @torch.no_grad()
    def prune(self, visible_cells: Bool[Tensor, "G G G"]) -> None:
        """Zeroes the vertices that no position in the visible cells reads."""
        read = vertices_of_cells(visible_cells, self.cells)
        for mode in range(3):
            self.planes[mode][~read.any(mode)] = 0
            a, b = PLANE_AXES[mode]
            self.lines[mode][~read.any(b).any(a)] = 0

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        """Resizes to the resolution of the loaded state, which may come from another growth stage."""
        planes, lines = (state_dict.get(f"{prefix}{name}") for name in ("planes", "lines"))
        if planes is not None and lines is not None and lines.ndim == 3 and 1 < lines.shape[1] != self.lines.shape[1]:
            side = lines.shape[1]
            if planes.shape[1:3] == (side, side):  # otherwise loading fails below
                self.resize(side - 1)
        super()._load_from_state_dict(state_dict, prefix, *rest)


class TensoRFField(Field):
    """TensoRF: density as a sum of planes times lines; color from a small network of such products and the direction.

    Planes are upsampled during training: a coarse grid finds the shape sooner. The network's first layer includes the
    paper's basis matrix.

    Args:
        bounds: the box the planes cover.
        density_components, color_components: channels of each plane; multiples of 8 are fastest on a CPU.
        base_resolution, max_resolution: initial and final cells along a side. None: 160, more for larger photos, see
            `Bounds.resolution_scale`.
        stages: number of resolutions, growing geometrically.
        growth_end: training progress at which the final resolution is reached; earlier stages have equal lengths, within
            `MIN_STEPS_PER_STAGE` and `MAX_STEPS_PER_STAGE`.
        width: neurons of the hidden layer. None: 32, up to 64 where larger photos make planes finer.
        degree: degree of the spherical harmonics of the direction, 0 to 3; 0 makes colors view-independent. With few
            photos, less than 3 may be better.
        density: "relu", "softplus" or "exp".
        size: "auto" limits both resolutions to what the photos resolve; "fixed" does not.

    Raises:
        InputError: where base_resolution > max_resolution, and for a single stage with two resolutions.
    """

    max_lr = 0.2

    def __init__(
        self,
        bounds: Bounds,
        density_components: Count = 16,
        color_components: Count = 16,
        base_resolution: GridSize = 64,
        max_resolution: GridSize | None = None,
        stages: Layers = 4,
        growth_end: Fraction = 0.3,
        width: Count | None = None,
        degree: SHDegree = 3,
        density: Activation = "exp",
        size: Size = "auto",
    ):
        super().__init__(bounds)
        self.has_auto_resolution = max_resolution is None
        resolution_scale = bounds.resolution_scale if max_resolution is None else 1.0
        if max_resolution is None:
            max_resolution = max(base_resolution, round(DEFAULT_MAX_RESOLUTION * resolution_scale))
        if width is None:
            width = 8 * round(DEFAULT_WIDTH * resolution_scale / 8)
        base_resolution, max_resolution = self.limit_resolutions(base_resolution, max_resolution, size)
        if stages == 1 and base_resolution < max_resolution:
            problem = f"1 with sizes {base_resolution} and {max_resolution}"
            raise InputError("model.stages", "", problem, "at least 2, or one size")
        self.resolutions = level_resolutions(stages, base_resolution, max_resolution)
        if base_resolution < max_resolution:
            starts = [growth_end * i / (stages - 1) for i in range(stages)]
            steps = MIN_STEPS_PER_STAGE * (stages - 1), MAX_STEPS_PER_STAGE * (stages - 1)
            self.growth = ResolutionSchedule(self.resolutions, starts, *steps)
        self.density_volume = VectorMatrix(base_resolution, density_components)
        self.color_volume = VectorMatrix(base_resolution, color_components)
        self.activation = density_activation(density)
        self.terms = num_sh_bases(degree)
        self.color_net = build_layers(3 * color_components + self.terms, width, 3)

    @property
    def resolution_scale(self) -> float:
        return max(1.0, self.density_volume.cells / DEFAULT_MAX_RESOLUTION) if self.has_auto_resolution else 1.0

    def features(
        self, positions: Float[Tensor, "N 3"], unit_length: float = 1.0
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        """See `Field.features`; the density is divided by `unit_length`."""
        density, color = self.density_volume, self.color_volume
        factors = (density.planes, density.lines), (color.planes, color.lines)
        return plane_line_sum_and_products(*factors, self.bounds.to_unit(positions), self.activation, unit_length)

    def density(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Density of `forward`, without computing the color."""
        factors, unit = (self.density_volume.planes, self.density_volume.lines), self.bounds.to_unit(positions)
        return plane_line_sum(*factors, unit, self.activation, self.unit_length)

    def forward(self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> FieldOutput:
        density, features = self.features(positions, self.unit_length)
        return FieldOutput(density, self.color(features, directions))

    def color(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        basis = encode_directions(directions, self.terms)
        return mlp(features, layer_parameters(self.color_net), basis, torch.sigmoid)

    def prune(self, visible_cells: Bool[Tensor, "G G G"]) -> None:
        self.density_volume.prune(visible_cells)
        self.color_volume.prune(visible_cells)

    @torch.no_grad()
    def warm_start_from(self, smaller: Field) -> None:
        """Copies all parameters and upsamples to the final resolution at once: coarse stages are already trained."""
        assert isinstance(smaller, TensoRFField)
        # Density is a plain sum; new color components have no effect while their network weights are zero.
        self.density_volume.warm_start_from(smaller.density_volume, zero_init=True)
        self.color_volume.warm_start_from(smaller.color_volume, zero_init=False)
        for volume in (self.density_volume, self.color_volume):
            if volume.cells < self.resolutions[-1]:
                volume.resize(self.resolutions[-1])
        width, smaller_width = (volume.lines.shape[2] for volume in (self.color_volume, smaller.color_volume))
        products = [mode * width + component for mode in range(3) for component in range(smaller_width)]
        columns = torch.tensor([*products, *range(3 * width, 3 * width + smaller.terms)])
        widen(linear_layers(self.color_net), linear_layers(smaller.color_net), columns)

    def max_num_parameters(self) -> int:
        components = self.density_volume.lines.shape[2] + self.color_volume.lines.shape[2]
        now, last = self.density_volume.cells + 1, self.resolutions[-1] + 1
        return super().max_num_parameters() + 3 * components * (last * last + last - now * now - now)

    @property
    def stage(self) -> int:
        return max(sum(cells <= self.density_volume.cells for cells in self.resolutions) - 1, 0)

    def upsample(self, stage: int) -> list[torch.nn.Parameter]:
        for volume in (self.density_volume, self.color_volume):
            volume.resize(self.resolutions[stage])
        return [*self.density_volume.parameters(), *self.color_volume.parameters()]
