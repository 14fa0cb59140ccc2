"""Synthetic rooms: a subject on a floor, within walls, photographed by hand from a ring around it."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, look_at
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.synthetic.objects import Box, Primitive, Sphere, make_pinhole_cameras, render_photos

FIELD_OF_VIEW_RAD = 1.0  # horizontal
HAND_SHAKE_STD = 0.06
"""Standard deviation of position and aim, relative to the distance to the subject."""
SUPERSAMPLING = 2  # rays along each side of a pixel


@dataclass(frozen=True)
class Room:
    """A subject at the origin, photographed from a distance of 1, and its surroundings."""

    primitives: list[Primitive]
    num_subject_primitives: int
    """Number of leading primitives that form the subject."""


def make_walls(
    half_width: float, floor: float, height: float, frequency: float, floor_frequency: float
) -> list[Primitive]:
    """Makes four walls, a floor and a ceiling, in this order: the inner faces of six slabs."""
    low, high = (-half_width, -half_width, floor), (half_width, half_width, floor + height)
    slabs: list[Primitive] = []
    for axis in range(3):
        for side in (0, 1):
            start, end = [c - 0.5 for c in low], [c + 0.5 for c in high]
            start[axis], end[axis] = (high[axis], high[axis] + 0.5) if side else (low[axis] - 0.5, low[axis])
            face_frequency = floor_frequency if (axis, side) == (2, 0) else frequency
            slabs.append(Box((start[0], start[1], start[2]), (end[0], end[1], end[2]), face_frequency))
    return slabs


def make_subject(size: float, frequency: float) -> list[Primitive]:
    """Makes a subject around the origin, standing on z = -size."""
    return [
        Box((-0.6 * size, -0.5 * size, -size), (0.4 * size, 0.5 * size, 0.2 * size), frequency),
        Sphere((0.0, 0.0, 0.5 * size), 0.45 * size, frequency),
        Sphere((0.75 * size, 0.1 * size, -0.7 * size), 0.3 * size, frequency),
    ]


ROOMS = {
    "small subject": Room([*make_subject(0.1, 25.0), *make_walls(3.0, -0.1, 2.5, 2.0, 6.0)], 3),
    "plain floor": Room([*make_subject(0.3, 10.0), *make_walls(8.0, -0.3, 6.0, 1.0, 0.3)], 3),
    "filling subject": Room([*make_subject(0.5, 6.0), *make_walls(3.0, -0.5, 2.5, 2.0, 4.0)], 3),
}
"""A `frequency` well below 1 gives a smooth gradient, like a textureless floor."""


def make_handheld_cameras(count: int, width: int, height: int, seed: int) -> Cameras:
    """Handheld cameras on two rings around the origin, not quite level or centered; width x height pixels."""
    generator = torch.Generator().manual_seed(seed)

    def shake() -> Tensor:
        return HAND_SHAKE_STD * torch.randn(count, 3, generator=generator, dtype=torch.float64)

    azimuth = 4 * math.pi * torch.arange(count, dtype=torch.float64) / count
    elevation = torch.where(torch.arange(count) < count // 2, 0.35, 0.75).double()
    ring = elevation.cos()
    eyes = torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), elevation.sin()], dim=1) + shake()
    up = torch.tensor([0.0, 0.0, 1.0]).double() + shake()
    c2w = torch.stack([look_at(*it) for it in zip(eyes[:, None], shake(), up, strict=True)])[:, 0].float()
    return make_pinhole_cameras(c2w, width, height, FIELD_OF_VIEW_RAD)


def render_room(room: Room, cameras: Cameras) -> Views:
    return Views.from_images(render_photos(room.primitives, cameras, (0.0, 0.0, 0.0), SUPERSAMPLING), cameras)


def make_room_scene(room: Room, seed: int, size: int = 40, views: int = 28, held_out: int = 4) -> Scene:
    """Makes a small unbounded scene of a room, `size` pixels along each side."""
    return Scene(
        name="room",
        source=BUILT_IN,
        train=render_room(room, make_handheld_cameras(views, size, size, seed)),
        val=render_room(room, make_handheld_cameras(held_out, size, size, seed + 1)),
        orbit=make_handheld_cameras(8, size, size, seed + 2),
        bounds=Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), unbounded=True),
    )
