"""A sparse grid of densities and spherical-harmonics colours, without any network (Plenoxels, Fridovich-Keil et al. 2022)."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import (
    spherical_harmonics,
    touch_rows,
    voxel_colour,
    voxel_value,
    voxel_values_reference,
)
from nerf_lightning.model.activation import truncated_exp
from nerf_lightning.model.field import Field, replace_data
from nerf_lightning.options import Count

EMPTY = -8.0
"""Logarithm of the density (in 1 / half-size) where no vertex is kept: nothing that a ray would notice."""
CHUNK = 1 << 16
"""Vertices interpolated together when growing: bounds the memory."""


class VoxelField(Field):
    """Vertices of a cubic grid over the bounds, each with a log-density and three rows of spherical-harmonics coefficients.

    Both are interpolated trilinearly before the density's exponential and the colour's sigmoid, which keeps surfaces sharp
    (DVGO, Sun et al. 2022, section 4). Training starts on a coarse, full grid. It grows finer in stages, and at each one drops
    the vertices that no sample has read in the latter half of the last: as samplers pass on only what light reaches, this is
    pruning by visibility. Row 0 stands for all vertices that are not kept, and never learns.

    Args:
        bounds: the box the grid covers.
        coarsest, finest: cells along a side at the start and at the end.
        stages: how many sizes there are, growing geometrically.
        grown: fraction of the budget after which the grid has its finest size.
        degree: of the spherical harmonics, 0 to 3.
        density_rate: factor on the learning rate of the log-densities, relative to the colours'.

    Raises:
        InputError: where coarsest > finest, for a degree above 3, or a fraction outside (0, 1].
    """

    index: Tensor
    touched: Tensor
    stage: Tensor
    settled: Tensor

    def __init__(
        self,
        bounds: Bounds,
        coarsest: Count = 40,
        finest: Count = 160,
        stages: Count = 4,
        grown: float = 0.3,
        degree: int = 1,
        density_rate: float = 4.0,
    ):
        super().__init__(bounds)
        if coarsest > finest:
            raise InputError("model.coarsest", "", f"{coarsest} with model.finest={finest}", "coarsest <= finest")
        if not 0 <= degree <= 3:
            raise InputError("model.degree", "", str(degree), "0 to 3")
        if not 0 < grown <= 1:
            raise InputError("model.grown", "", str(grown), "above 0, at most 1")
        steps = max(stages - 1, 1)
        self.resolutions = [round(coarsest * (finest / coarsest) ** (i / steps)) for i in range(stages)]
        # Early stages are short: a coarse grid learns what it can in a few steps a vertex.
        self.times = [grown * (i / steps) ** 2 for i in range(stages)]
        self.terms = (degree + 1) ** 2
        self.density_rate = density_rate
        side = self.resolutions[0] + 1
        self.register_buffer("index", torch.arange(1, side**3 + 1, dtype=torch.int32))
        self.register_buffer("touched", torch.zeros(side**3 + 1, dtype=torch.bool))
        self.register_buffer("stage", torch.tensor(0))
        self.register_buffer("settled", torch.tensor(False))
        self.log_density = torch.nn.Parameter(torch.zeros(side**3 + 1))  # divided by density_rate
        self.log_density.data[0] = EMPTY / density_rate
        self.coefficients = torch.nn.Parameter(torch.zeros(side**3 + 1, 3 * self.terms))

    def raw_density(self, unit: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        return truncated_exp(self.density_rate * voxel_value(self.log_density, self.index, unit))

    def density(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        return self.raw_density(self.bounds.to_unit(positions)) / self.unit_length

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        unit = self.bounds.to_unit(positions)
        return self.raw_density(unit), voxel_values_reference(self.coefficients, self.index, unit)

    def basis(self, directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N B"]:
        return spherical_harmonics(directions)[:, : self.terms]

    def colour(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        mixed = features.view(len(features), 3, self.terms)
        return torch.sigmoid(torch.einsum("ncb,nb->nc", mixed, self.basis(directions)))

    def forward(
        self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
        """As `features` and `colour`, but the coefficients are summed as they are read."""
        unit = self.bounds.to_unit(positions)
        if torch.is_grad_enabled():
            touch_rows(self.touched, self.index, unit)
        rgb = torch.sigmoid(voxel_colour(self.coefficients, self.index, unit, self.basis(directions)))
        return self.raw_density(unit) / self.unit_length, rgb

    @torch.no_grad()
    def grow(self, progress: float) -> list[torch.nn.Parameter]:
        """Moves on to the size that `progress` asks for."""
        wanted = max(i for i, time in enumerate(self.times) if progress >= time)
        stage = int(self.stage)
        if wanted <= stage:
            if stage + 1 < len(self.times) and not self.settled and 2 * progress >= sum(self.times[stage : stage + 2]):
                self.touched.zero_()
                self.settled.fill_(True)
            return []
        keep = self.surroundings(self.resolutions[wanted] + 1)
        log_density, coefficients = self.log_density.detach(), self.coefficients.detach()
        places = keep.nonzero() / (keep.shape[0] - 1)
        rows = [[log_density[:1]], [coefficients[:1]]]
        for part in places.split(CHUNK):
            rows[0].append(voxel_values_reference(log_density, self.index, part))
            rows[1].append(voxel_values_reference(coefficients, self.index, part))
        replace_data(self.log_density, torch.cat(rows[0]))
        replace_data(self.coefficients, torch.cat(rows[1]))
        flat = keep.flatten()
        self.index = torch.where(flat, flat.cumsum(0), 0).int()
        self.touched = torch.zeros(len(self.log_density), dtype=torch.bool, device=flat.device)
        self.stage.fill_(wanted)
        self.settled.fill_(False)
        return [self.log_density, self.coefficients]

    def surroundings(self, side: int) -> Tensor:
        """Which vertices of a grid of side^3 lie within one present cell of a vertex that has been read."""
        touched = self.touched.clone()
        touched[0] = False
        old = round(len(self.index) ** (1 / 3))
        seen = touched[self.index.long()].view(1, 1, old, old, old).float()
        if not seen.any():
            seen = torch.ones_like(seen)  # nothing was rendered yet: keep everything
        grown = torch.nn.functional.interpolate(seen, size=(side, side, side), mode="trilinear", align_corners=True)
        return grown[0, 0] > 0

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        """Takes the sizes of the state that is being loaded: a grid of another stage has other shapes."""
        for name in ("index", "touched"):
            if prefix + name in state_dict:
                setattr(self, name, torch.empty_like(state_dict[prefix + name], device=self.aabb.device))
        for name in ("log_density", "coefficients"):
            if prefix + name in state_dict:
                replace_data(getattr(self, name), torch.empty_like(state_dict[prefix + name], device=self.aabb.device))
        super()._load_from_state_dict(state_dict, prefix, *rest)
