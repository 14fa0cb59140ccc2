"""Rooms with exact geometry: a subject on a floor, within walls, photographed by hand from a ring around it."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays, look_at
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.stability.toys import Ball, Block, Body, pattern

FIELD_OF_VIEW = 1.0
"""The horizontal angle in radians."""
FINER = 2
"""Rays along each side of a pixel, to average over."""
SHAKE = 0.06
"""Standard deviation of where a hand aims and stands, in distances to the subject."""


@dataclass(frozen=True)
class Room:
    """Bodies, each with the grain of its pattern (see `pattern`; well below 1 it is a smooth change of colour). The first
    `subject` of them are photographed, at the origin, from a distance of 1."""

    bodies: list[tuple[Body, float]]
    subject: int

    @property
    def floor(self) -> int:
        """The number of the floor: `walls` come last, four of the sides, then the floor and the ceiling."""
        return len(self.bodies) - 2

    def see(self, rays: Rays) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"], Int[Tensor, "R"]]:
        """Colour, distance and number of the body that each ray meets."""
        met = [body.meet(rays) for body, _ in self.bodies]
        distance, which = torch.stack([t for t, _ in met]).min(0)
        normals = torch.stack([normal for _, normal in met])[which, torch.arange(len(rays))]
        grain = torch.tensor([grain for _, grain in self.bodies])[which]
        points = rays.origins + rays.directions * distance[:, None]
        return pattern(points, normals, grain[:, None]), distance, which


def walls(reach: float, floor: float, height: float, grain: float, floor_grain: float) -> list[tuple[Body, float]]:
    """A floor, a ceiling and four walls: the inner faces of six slabs."""
    low, high = (-reach, -reach, floor), (reach, reach, floor + height)
    slabs: list[tuple[Body, float]] = []
    for axis in range(3):
        for side in (0, 1):
            start, end = [c - 0.5 for c in low], [c + 0.5 for c in high]
            start[axis], end[axis] = (high[axis], high[axis] + 0.5) if side else (low[axis] - 0.5, low[axis])
            here = floor_grain if (axis, side) == (2, 0) else grain
            slabs.append((Block((start[0], start[1], start[2]), (end[0], end[1], end[2])), here))
    return slabs


def pile(size: float, grain: float) -> list[tuple[Body, float]]:
    """A subject around the origin, standing on z = -size."""
    bodies: list[Body] = [
        Block((-0.6 * size, -0.5 * size, -size), (0.4 * size, 0.5 * size, 0.2 * size)),
        Ball((0.0, 0.0, 0.5 * size), 0.45 * size),
        Ball((0.75 * size, 0.1 * size, -0.7 * size), 0.3 * size),
    ]
    return [(body, grain) for body in bodies]


ROOMS = {
    "small subject": Room([*pile(0.1, 25.0), *walls(3.0, -0.1, 2.5, 2.0, 6.0)], 3),
    "plain floor": Room([*pile(0.3, 10.0), *walls(8.0, -0.3, 6.0, 1.0, 0.3)], 3),
    "filling subject": Room([*pile(0.5, 6.0), *walls(3.0, -0.5, 2.5, 2.0, 4.0)], 3),
}


def handheld(count: int, width: int, height: int, seed: int) -> Cameras:
    """Two rings around the origin at two heights, not quite level, not quite centred; pictures of width x height pixels."""
    generator = torch.Generator().manual_seed(seed)

    def shaken(size: float) -> Tensor:
        return size * torch.randn(count, 3, generator=generator, dtype=torch.float64)

    turn = 4 * math.pi * torch.arange(count, dtype=torch.float64) / count
    tall = torch.where(torch.arange(count) < count // 2, 0.35, 0.75).double()
    eyes = torch.stack([tall.cos() * turn.cos(), tall.cos() * turn.sin(), tall.sin()], dim=1) + shaken(SHAKE)
    up = torch.tensor([0.0, 0.0, 1.0]).double() + shaken(SHAKE)
    c2w = torch.stack([look_at(*it) for it in zip(eyes[:, None], shaken(SHAKE), up, strict=True)])[:, 0].float()
    focal = 0.5 * width / math.tan(0.5 * FIELD_OF_VIEW)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Cameras.of_size(K.repeat(count, 1, 1), c2w, width, height)


def photograph(room: Room, cameras: Cameras, view: int) -> UInt8[Tensor, "H W 3"]:
    """What one camera sees."""
    fine = cameras.scaled(FINER)
    colours = room.see(fine.view_rays(view))[0].view(cameras.height, FINER, cameras.width, FINER, 3).mean((1, 3))
    return (colours.clamp(0, 1) * 255).round().to(torch.uint8)


def indoors(room: Room, seed: int, size: int = 40, views: int = 28, held_out: int = 4) -> Scene:
    """A small scene without bounds: photos of a room, `size` pixels along each side."""
    train, val = handheld(views, size, size, seed), handheld(held_out, size, size, seed + 1)
    pictures = [torch.stack([photograph(room, some, view) for view in range(len(some))]) for some in (train, val)]
    return Scene(
        name="room",
        source=BUILT_IN,
        train=Views.of(pictures[0], train),
        val=Views.of(pictures[1], val),
        orbit=handheld(8, size, size, seed + 2),
        bounds=Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), unbounded=True),
    )
