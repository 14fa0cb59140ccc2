"""Captures with exact geometry: a subject in a furnished room, photographed by hand from a ring around it."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import Cameras, Rays, look_at
from nerf_lightning.dataset import Scene
from nerf_lightning.stability.toys import Ball, Block, Body, pattern

WIDTH, HEIGHT, FIELD_OF_VIEW = 240, 180, 1.0
"""Pixels, and the horizontal angle in radians."""
VIEWS = 56
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

    def see(self, rays: Rays) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"], Float[Tensor, "R"]]:
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


def handheld(seed: int) -> Cameras:
    """Two rings around the origin at two heights, not quite level, not quite centred."""
    generator = torch.Generator().manual_seed(seed)

    def shaken(size: float) -> Tensor:
        return size * torch.randn(VIEWS, 3, generator=generator, dtype=torch.float64)

    turn = 4 * math.pi * torch.arange(VIEWS, dtype=torch.float64) / VIEWS
    height = torch.where(torch.arange(VIEWS) < VIEWS // 2, 0.35, 0.75).double()
    eyes = torch.stack([height.cos() * turn.cos(), height.cos() * turn.sin(), height.sin()], dim=1) + shaken(SHAKE)
    up = torch.tensor([0.0, 0.0, 1.0]).double() + shaken(SHAKE)
    c2w = torch.stack([look_at(*it) for it in zip(eyes[:, None], shaken(SHAKE), up, strict=True)])[:, 0].float()
    focal = 0.5 * WIDTH / math.tan(0.5 * FIELD_OF_VIEW)
    K = torch.tensor([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Cameras.of_size(K.repeat(VIEWS, 1, 1), c2w, WIDTH, HEIGHT)


def photograph(room: Room, cameras: Cameras, view: int) -> UInt8[Tensor, "H W 3"]:
    """What one camera sees."""
    fine = cameras.scaled(FINER)
    colours = room.see(fine.view_rays(view))[0].view(cameras.height, FINER, cameras.width, FINER, 3).mean((1, 3))
    return (colours.clamp(0, 1) * 255).round().to(torch.uint8)


def write_room(room: Room, folder: Path, seed: int = 0) -> None:
    """Writes photos and a transforms.json."""
    (folder / "images").mkdir(parents=True)
    cameras, frames = handheld(seed), []
    for view in range(VIEWS):
        name = f"images/{view:03d}.png"
        imageio.imwrite(folder / name, photograph(room, cameras, view).numpy())
        pose = cameras.c2w[view] * torch.tensor([1.0, -1.0, -1.0, 1.0])  # OpenGL: y up, looking along -z
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    K = cameras.K[0]
    lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    (folder / "transforms.json").write_text(json.dumps({**lens, "w": WIDTH, "h": HEIGHT, "frames": frames}))


def true_view(room: Room, scene: Scene, view: int) -> tuple[Float[Tensor, "R"], Float[Tensor, "R"]]:
    """Distance of what the rays of a held-out view meet, scene's unit, and the body's number."""
    rays = scene.val.cameras.view_rays(view)
    scale = float(torch.linalg.det(scene.to_source[:3, :3])) ** (1 / 3)
    turn, shift = scene.to_source[:3, :3], scene.to_source[:3, 3]
    there = Rays(rays.origins @ turn.mT + shift, rays.directions @ turn.mT / scale)
    _, distance, which = room.see(there)
    return distance / scale, which
