"""Small scenes with exact geometry, traced in a fraction of a second: balls and boxes with a smooth pattern.

Any bodies on any background, which the built-in scene's tracer cannot do: that one draws one model, lit and with shadows.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays, look_at
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views

DISTANCE, FIELD_OF_VIEW = 4.0, 0.7
"""Distance of the cameras from the origin; horizontal field of view, radians."""
FINER = 3
"""Rays along each side of a pixel, to average over."""
TILE = 90
"""Rays along each side of a tile: small enough for the processor's cache, and for `in_sight` to drop most bodies."""
LIGHT = (0.5, -0.4, 0.77)
"""Direction towards the light, nearly unit."""


@dataclass(frozen=True)
class Ball:
    """A sphere, world units."""

    centre: tuple[float, float, float]
    radius: float

    def meet(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R 3"]]:
        """Distance along each ray to the surface (infinite where it misses) and the outward normal there."""
        offset = rays.origins - torch.tensor(self.centre)
        half = (offset * rays.directions).sum(1)
        inside = half**2 - (offset * offset).sum(1) + self.radius**2
        t = torch.where(inside >= 0, -half - inside.clamp_min(0).sqrt(), math.inf)
        t = torch.where(t > 0, t, math.inf)
        points = rays.origins + rays.directions * t.nan_to_num(posinf=0)[:, None]
        return t, (points - torch.tensor(self.centre)) / self.radius

    @cached_property
    def box(self) -> Float[Tensor, "2 3"]:
        centre = torch.tensor(self.centre)
        return torch.stack([centre - self.radius, centre + self.radius])


@dataclass(frozen=True)
class Block:
    """A box along the axes, world units."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def meet(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R 3"]]:
        """As `Ball.meet`."""
        low, high = self.box
        first = (low - rays.origins) / rays.directions
        second = (high - rays.origins) / rays.directions
        enters, axis = torch.minimum(first, second).max(1)
        leaves = torch.maximum(first, second).min(1).values
        t = torch.where((leaves > enters) & (enters > 0), enters, math.inf)
        normals = torch.nn.functional.one_hot(axis, 3).to(t.dtype) * -rays.directions.sign()
        return t, normals

    @cached_property
    def box(self) -> Float[Tensor, "2 3"]:
        return torch.tensor([self.low, self.high])


Body = Ball | Block


def pattern(
    points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grain: float | Float[Tensor, "N 1"] = 1.0
) -> Float[Tensor, "N 3"]:
    """The colour of a surface: three waves, lit from one side; finer with larger `grain`, plain for 0."""
    waves = torch.tensor([[5.0, 2.0, 1.0], [-2.0, 6.0, 3.0], [1.0, -3.0, 7.0]])
    colour = 0.5 + 0.35 * torch.sin(grain * points @ waves.T + torch.tensor([0.0, 1.0, 2.0]))
    light = (normals @ torch.tensor(LIGHT)).clamp_min(0)
    return colour * (0.45 + 0.55 * light[:, None])


def trace(bodies: list[Body], rays: Rays, grain: float = 1.0) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"]]:
    """Colour and coverage (0 or 1) along rays."""
    met = [body.meet(rays) for body in bodies]
    nearest, which = torch.stack([t for t, _ in met]).min(0)
    normals = torch.stack([normal for _, normal in met])[which, torch.arange(len(rays))]
    hit = nearest.isfinite()
    points = rays.origins + rays.directions * nearest.nan_to_num(posinf=0)[:, None]
    return torch.where(hit[:, None], pattern(points, normals, grain), 0.0), hit.to(torch.float32)


def in_sight(bodies: list[Body], rays: Rays) -> list[Body]:
    """The bodies that rays from one point may hit: those whose bounding ball reaches into the cone around the rays."""
    boxes = torch.stack([body.box for body in bodies])
    offset = boxes.mean(1) - rays.origins[0]
    distance, radius = offset.norm(dim=1), (boxes[:, 1] - boxes[:, 0]).norm(dim=1) / 2
    axis = torch.nn.functional.normalize(rays.directions.mean(0), dim=0)
    cone = (rays.directions @ axis).min().clamp(-1, 1).acos()
    ball = (radius / distance).clamp(max=1).asin()
    away = (offset @ axis / distance).clamp(-1, 1).acos()
    seen = (away <= cone + ball + 1e-3) | (distance <= radius)
    return [body for body, it in zip(bodies, seen.tolist(), strict=True) if it]


def photograph(
    bodies: list[Body], cameras: Cameras, background: tuple[float, float, float] | None, grain: float = 1.0
) -> UInt8[Tensor, "V H W C"]:
    """Pictures on a background, or with alpha if it is None."""
    fine = cameras.scaled(FINER)
    pixels = torch.arange(fine.height * fine.width).view(fine.height, fine.width)
    tiles = [tile.flatten() for row in pixels.split(TILE) for tile in row.split(TILE, dim=1)]
    pictures = []
    for view in range(len(cameras)):
        rays, layers = fine.view_rays(view), torch.zeros(fine.height * fine.width, 4)
        for tile in tiles:
            some = rays[tile]
            near = in_sight(bodies, some)
            if near:
                colour, cover = trace(near, some, grain)
                layers[tile] = torch.cat([colour * cover[:, None], cover[:, None]], dim=1)
        layers = layers.view(fine.height, fine.width, 4)
        mean = layers.view(cameras.height, FINER, cameras.width, FINER, 4).mean((1, 3))
        premultiplied, alpha = mean[..., :3], mean[..., 3:]
        if background is None:
            picture = torch.cat([premultiplied / alpha.clamp_min(1e-6), alpha], dim=-1)
        else:
            picture = premultiplied + (1 - alpha) * torch.tensor(background)
        pictures.append((picture.clamp(0, 1) * 255).round().to(torch.uint8))
    return torch.stack(pictures)


def around(count: int, size: int, phase: float = 0.0, distance: float = DISTANCE) -> Cameras:
    """Cameras spread over the upper part of a sphere, looking at the origin; `phase` turns them about z.

    Equal steps in height are equal areas of the sphere; the golden angle between neighbours keeps them apart.
    """
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 0.05 + 0.85 * index / count
    azimuth = index * math.pi * (3 - math.sqrt(5)) + phase
    ring = (1 - z**2).sqrt()
    eye = distance * torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], dim=1)
    c2w = look_at(eye, torch.zeros(3).double(), torch.tensor([0.0, 0.0, 1.0]).double()).float()
    focal = 0.5 * size / math.tan(0.5 * FIELD_OF_VIEW)
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    return Cameras.of_size(K.repeat(count, 1, 1), c2w, size, size)


def enclosing(bodies: list[Body]) -> Bounds:
    """The box around bodies, with some room."""
    boxes = torch.stack([body.box for body in bodies])
    low, high = boxes[:, 0].amin(0), boxes[:, 1].amax(0)
    centre, half = (low + high) / 2, (high - low) / 2
    return Bounds(torch.stack([centre - 1.1 * half, centre + 1.1 * half]))


def toy(
    bodies: list[Body],
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
    size: int = 40,
    views: int = 24,
    held_out: int = 4,
    grain: float = 1.0,
) -> Scene:
    """A scene of bodies around the origin, with exact cameras and bounds.

    Args:
        bodies: within about 1 of the origin.
        background: baked into the pictures; None for pictures with alpha.
        size: pixels along each side.
        views, held_out: number of training and held-out views.
        grain: fineness of the pattern on the bodies.
    """
    train, val = around(views, size), around(held_out, size, phase=0.7)
    return Scene(
        name="toy",
        source=BUILT_IN,
        train=Views.of(photograph(bodies, train, background, grain), train),
        val=Views.of(photograph(bodies, val, background, grain), val),
        orbit=around(8, size, phase=0.3),
        bounds=enclosing(bodies),
        background=background or (0.0, 0.0, 0.0),
    )


PILE: list[Body] = [
    Ball((0.3, 0.2, 0.1), 0.55),
    Ball((-0.5, -0.3, 0.0), 0.4),
    Block((-0.8, 0.2, -0.4), (-0.2, 0.8, 0.3)),
    Block((-0.9, -0.9, -0.6), (0.9, 0.9, -0.4)),
]
"""The scene of most conditions."""
MARBLE: list[Body] = [Ball((0.0, 0.0, 0.0), 0.3)]
"""Small: three percent of a picture."""
ROD: list[Body] = [Block((-0.02, -0.02, -0.8), (0.02, 0.02, 0.8)), Block((-0.6, -0.6, -0.9), (0.6, 0.6, -0.8))]
"""Thinner than a pixel, on a plate."""
