"""Cameras and the rays through their pixels."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.cameras.lenses import (
    Lenses,
    Projection,
    directions_to_normalized,
    distort,
    normalized_to_directions,
    undistort,
)
from nerf_lightning.cameras.transforms import pixels_to_normalized
from nerf_lightning.utils.tensor_dataclass import TensorDataclass

PINHOLE_FOV_DEG, PINHOLE_ASPECT = 90.0, 4 / 3
"""Horizontal field of view and aspect ratio of the pinhole cameras that replace equirectangular ones."""
UNDISTORT_TABLE_SIZE = 33
"""Entries per side of the precomputed undistortion table; between them one Newton step is accurate enough."""


@dataclass(frozen=True)
class Rays(TensorDataclass):
    """Half-lines in the world frame: x(t) = origin + t * direction, t > 0 in the scene's unit."""

    origins: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    """Unit length."""

    def __len__(self) -> int:
        return self.origins.shape[0]


@dataclass(frozen=True)
class Cameras(TensorDataclass):
    """V cameras, OpenCV frame, each of its own size: intrinsics `K` in pixels, poses `c2w` camera to world."""

    K: Float[Tensor, "V 3 3"]
    c2w: Float[Tensor, "V 4 4"]
    sizes: Int[Tensor, "V 2"]
    """Width and height in pixels; always on the CPU."""
    lenses: Lenses | None = None
    """None for pinhole cameras."""

    @classmethod
    def pinhole(cls, K: Float[Tensor, "V 3 3"], c2w: Float[Tensor, "V 4 4"], width: int, height: int) -> "Cameras":
        """Pinhole cameras of one size."""
        return cls(K, c2w, torch.tensor([[width, height]]).repeat(len(c2w), 1))

    def __len__(self) -> int:
        return self.c2w.shape[0]

    def __getitem__(self, index: int | slice | Tensor) -> "Cameras":
        """Selects views; an integer gives Cameras with that one view."""
        if isinstance(index, int):
            index = torch.tensor([index])
        sizes = self.sizes[index.cpu() if isinstance(index, Tensor) else index]
        return Cameras(self.K[index], self.c2w[index], sizes, None if self.lenses is None else self.lenses[index])

    def map_tensors(self, operation: Callable[[Tensor], Tensor]) -> "Cameras":
        """Applies an operation to each tensor but the sizes."""
        return replace(super().map_tensors(operation), sizes=self.sizes)

    @property
    def centers(self) -> Float[Tensor, "V 3"]:
        return self.c2w[:, :3, 3]

    def size(self, view: int) -> tuple[int, int]:
        """Width and height of a view."""
        width, height = self.sizes[view].tolist()
        return width, height

    @property
    def width(self) -> int:
        """Width of all views, which must share one size."""
        (width,) = self.sizes[:, 0].unique().tolist() or [0]
        return width

    @property
    def height(self) -> int:
        """Height of all views, which must share one size."""
        (height,) = self.sizes[:, 1].unique().tolist() or [0]
        return height

    @property
    def max_side(self) -> int:
        """The longest side of any view in pixels."""
        return int(self.sizes.max())

    def resize(self, sizes: Int[Tensor, "V 2"] | tuple[int, int]) -> "Cameras":
        """Resizes the pixel grids and scales K with them (pixel edges, not centers, stay in place)."""
        if isinstance(sizes, tuple):
            sizes = torch.tensor([sizes]).repeat(len(self), 1)
        scale = torch.cat([sizes.double() / self.sizes, torch.ones(len(self), 1, dtype=torch.float64)], dim=1)
        return replace(self, K=self.K * scale[:, :, None].to(self.K), sizes=sizes)

    def rescale(self, factor: float) -> "Cameras":
        """Scales the pixel grids by a factor, to at least one pixel."""
        return self.resize((self.sizes * factor).round().long().clamp_min(1))

    def zoom(self, factor: float) -> "Cameras":
        """Multiplies the focal length by a factor, and adapts the lenses so that each pixel keeps its distortion."""
        K = self.K.clone()
        K[:, :2, :2] *= factor
        return replace(self, K=K, lenses=None if self.lenses is None else self.lenses.zoom(factor))

    def to_pinhole(self) -> "Cameras":
        """Pinhole cameras without distortion; equirectangular ones become `PINHOLE_FOV_DEG` wide, at their resolution."""
        if self.lenses is None:
            return self
        focal = self.K[:, 0, 0].cpu()
        width = 2 * focal * math.tan(math.radians(PINHOLE_FOV_DEG) / 2)
        sizes = torch.stack([width, width / PINHOLE_ASPECT], dim=1).round().long().clamp_min(1)
        K = torch.diag_embed(torch.stack([focal, focal, torch.ones_like(focal)], dim=1))
        K[:, :2, 2] = sizes.to(K) / 2
        is_panorama = self.lenses.projection == Projection.EQUIRECTANGULAR
        sizes = torch.where(is_panorama.cpu()[:, None], sizes, self.sizes)
        return Cameras(torch.where(is_panorama[:, None, None], K.to(self.K), self.K), self.c2w, sizes)

    def pixel_footprint(self, point: Float[Tensor, "3"]) -> float:
        """Footprint of one pixel at a point, world units: the median over the views."""
        return float(((self.centers - point).norm(dim=1) / self.K[:, 0, 0]).median())

    def generate_rays(self, view: Int[Tensor, "#R"], row: Int[Tensor, "R"], col: Int[Tensor, "R"]) -> Rays:
        """Rays through the centers of the given pixels, of a view each or of one view."""
        u, v = col.to(self.K.dtype) + 0.5, row.to(self.K.dtype) + 0.5
        if self.lenses is None:
            u_axis, v_axis, offset = self.pixel_axes[view].unbind(1)
            directions = u_axis * u[:, None] + v_axis * v[:, None] + offset
        else:
            coefficients = self.lenses.coefficients[view]
            points = torch.stack([u, v], dim=1)
            start = self._interpolate_undistorted(view, points)
            normalized = undistort(pixels_to_normalized(self.K[view], points), coefficients, start, steps=1)
            local = normalized_to_directions(normalized, self.lenses.projection[view])
            directions = (self.c2w[view, :3, :3] * local[:, None]).sum(2)
        return Rays(
            self.centers[view].expand_as(directions).contiguous(), torch.nn.functional.normalize(directions, dim=1)
        )

    @cached_property
    def pixel_axes(self) -> Float[Tensor, "V 3 3"]:
        """World vectors a, b, c of each pinhole view: pixel (u, v) has direction u a + v b + c."""
        K, rotation = self.K.cpu().double(), self.c2w[:, :3, :3].cpu().double()  # not every device has doubles
        identity = torch.eye(3, dtype=torch.float64).expand_as(K)
        inverse = torch.linalg.solve_triangular(K, identity, upper=True)
        return (rotation @ inverse).mT.to(self.K).contiguous()

    def _interpolate_undistorted(self, view: Int[Tensor, "#R"], points: Float[Tensor, "R 2"]) -> Float[Tensor, "R 2"]:
        """Undistorted normalized coordinates of pixels, bilinear from the table: the start of one Newton step."""
        lens_index, tables, scale = self._undistort_tables
        lens = lens_index[view]
        grid_points = points * scale[view]
        low = grid_points.long().clamp(max=UNDISTORT_TABLE_SIZE - 2)
        weight_x, weight_y = (grid_points - low).unbind(1)
        first = (lens * UNDISTORT_TABLE_SIZE + low[:, 1]) * UNDISTORT_TABLE_SIZE + low[:, 0]
        corners = [tables[first + step] for step in (0, 1, UNDISTORT_TABLE_SIZE, UNDISTORT_TABLE_SIZE + 1)]
        top, bottom = (torch.lerp(a, b, weight_x[:, None]) for a, b in (corners[:2], corners[2:]))
        return torch.lerp(top, bottom, weight_y[:, None])

    @cached_property
    def _undistort_tables(self) -> tuple[Int[Tensor, "V"], Float[Tensor, "entries 2"], Float[Tensor, "V 2"]]:
        """Lens index of each view; undistortion tables of all lenses, concatenated; scale from pixels to table entries."""
        assert self.lenses is not None  # pinhole cameras need none
        sizes = self.sizes.to(self.K)
        keys = torch.cat([self.K.flatten(1), sizes, self.lenses.coefficients], dim=1)
        lenses, lens_index = torch.unique(keys, dim=0, return_inverse=True)
        K, size, coefficients = lenses.repeat_interleave(UNDISTORT_TABLE_SIZE**2, dim=0).tensor_split([9, 11], dim=1)
        t = torch.linspace(0, 1, UNDISTORT_TABLE_SIZE, dtype=self.K.dtype, device=self.K.device)
        lattice = torch.stack(torch.meshgrid(t, t, indexing="xy"), dim=2).view(-1, 2).repeat(len(lenses), 1)
        tables = undistort(pixels_to_normalized(K.view(-1, 3, 3), lattice * size), coefficients)
        return lens_index, tables, (UNDISTORT_TABLE_SIZE - 1) / sizes

    def generate_view_rays(self, view: int) -> Rays:
        """Rays of all H*W pixels of one view, row by row."""
        width, height = self.size(view)
        pixel = torch.arange(height * width, device=self.K.device)
        return self.generate_rays(pixel.new_full((1,), view), pixel // width, pixel % width)

    def project(
        self, points: Float[Tensor, "N 3"], view: int
    ) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N"], Bool[Tensor, "N"]]:
        """Projects world points into a view.

        Returns:
            Pixels (column, row; the first pixel's center is at 0.5), undefined for invisible points; depth along the
            optical axis, or distance in an equirectangular view, world units; mask of the points inside the photo.
        """
        local = (points - self.centers[view]).to(self.c2w) @ self.c2w[view, :3, :3]
        depth = local[:, 2]
        if self.lenses is None:
            is_visible, normalized = depth > 0, local[:, :2] / torch.where(depth > 0, depth, 1.0)[:, None]
        else:
            lens = self.lenses[view : view + 1]
            normalized = directions_to_normalized(local, lens.projection)
            # Beyond the valid radius a distortion polynomial may fold back into the photo.
            is_undistortable = normalized.norm(dim=1) <= self.max_visible_radius[view]
            is_visible = ((depth > 0) | (lens.projection != Projection.PERSPECTIVE)) & is_undistortable
            normalized = distort(normalized, lens.coefficients)[0]
        K, size = self.K[view], self.sizes[view].to(self.K)
        pixels = normalized @ K[:2, :2].T + K[:2, 2]
        if self.lenses is not None:
            is_panorama = lens.projection == Projection.EQUIRECTANGULAR
            depth = torch.where(is_panorama, local.norm(dim=1), depth)
            # The seam and the poles are clamped to the border.
            max_pixel = size * (1 - torch.finfo(size.dtype).eps)
            pixels = torch.where(is_panorama[:, None], pixels.clamp_min(0).minimum(max_pixel), pixels)
        inside = is_visible & (pixels >= 0).all(1) & (pixels < size).all(1)
        return pixels, depth, inside

    @cached_property
    def max_visible_radius(self) -> Float[Tensor, "V"]:
        """Largest normalized radius (see `Lenses`) that each view shows."""
        assert self.lenses is not None  # pinhole cameras need none
        lens_index, tables, _ = self._undistort_tables
        return (tables.norm(dim=1).view(-1, UNDISTORT_TABLE_SIZE**2).amax(1) * 1.001)[lens_index]


def has_panoramas(cameras: Cameras) -> bool:
    """True if any camera is equirectangular, so that its optical axis does not tell what it looks at."""
    lenses = cameras.lenses
    return lenses is not None and bool((lenses.projection == Projection.EQUIRECTANGULAR).any())
