"""Cameras and Rays, the data of the first stages."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """Half-lines in the world frame: x(t) = origin + t * direction, t > 0 in the scene's unit."""

    origins: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]
    """Unit length."""

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> "Rays":
        return Rays(self.origins[index], self.directions[index])

    def to(self, device: torch.device | str) -> "Rays":
        return Rays(self.origins.to(device), self.directions.to(device))


@dataclass(frozen=True)
class Cameras:
    """V pinhole views of one size, OpenCV frame, distortion already undone.

    `K` holds pixels, `c2w` maps camera to world.
    """

    K: Float[Tensor, "V 3 3"]
    c2w: Float[Tensor, "V 4 4"]
    width: int
    height: int

    def __len__(self) -> int:
        return self.c2w.shape[0]

    def __getitem__(self, index: int | slice | Tensor) -> "Cameras":
        """Some of the views; an integer gives Cameras with that one view."""
        if isinstance(index, int):
            index = torch.tensor([index])
        return replace(self, K=self.K[index], c2w=self.c2w[index])

    def to(self, device: torch.device | str) -> "Cameras":
        return replace(self, K=self.K.to(device), c2w=self.c2w.to(device))

    @property
    def centres(self) -> Float[Tensor, "V 3"]:
        return self.c2w[:, :3, 3]

    def resized(self, width: int, height: int) -> "Cameras":
        """The same views on another pixel grid; K scales with it (pixel edges, not centres, stay in place)."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=self.K.dtype)
        return replace(self, K=self.K * scale[:, None].to(self.K.device), width=width, height=height)

    def pixel_width(self, place: Float[Tensor, "3"]) -> float:
        """Width of what one pixel shows at a place, world units: the median over the views."""
        return float(((self.centres - place).norm(dim=1) / self.K[:, 0, 0]).median())

    def rays(self, view: Int[Tensor, "R"], row: Int[Tensor, "R"], col: Int[Tensor, "R"]) -> Rays:
        """Rays through the centres of the given pixels."""
        u, v = col.to(self.K.dtype) + 0.5, row.to(self.K.dtype) + 0.5
        across, down, ahead = self.pixel_axes[view].unbind(1)
        directions = torch.nn.functional.normalize(across * u[:, None] + down * v[:, None] + ahead, dim=1)
        return Rays(self.centres[view], directions)

    @cached_property
    def pixel_axes(self) -> Float[Tensor, "V 3 3"]:
        """World vectors a, b, c of each view: pixel (u, v) looks along u a + v b + c, as in `pixel_to_ray`."""
        K, rotation = self.K.cpu().double(), self.c2w[:, :3, :3].cpu().double()  # not every device has doubles
        identity = torch.eye(3, dtype=torch.float64).expand_as(K)
        inverse = torch.linalg.solve_triangular(K, identity, upper=True)
        return (rotation @ inverse).mT.to(self.K).contiguous()

    def view_rays(self, view: int) -> Rays:
        """All H*W rays of one view, row by row."""
        pixel = torch.arange(self.height * self.width, device=self.K.device)
        return self.rays(torch.full_like(pixel, view), pixel // self.width, pixel % self.width)
