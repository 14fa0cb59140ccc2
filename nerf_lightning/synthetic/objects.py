"""Small scenes with exact geometry: balls and blocks with a smooth pattern, ray traced in a fraction of a second.

Any bodies on any background, unlike the tracer of the built-in scene, which renders one model with light and shadows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays, look_at
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views

DISTANCE = 4.0
"""Of the cameras from the origin, world units."""
FIELD_OF_VIEW_RAD = 0.7
"""Horizontal."""
LIGHT = (0.5, -0.4, 0.77)
"""Direction towards the light, nearly unit."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Ball:
    """A sphere, world units."""

    centre: Point
    radius: float
    grain: float = 1.0
    """Fineness of the pattern, see `shade`."""

    def intersect(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R 3"]]:
        """Distance along each ray to the surface (infinite where it misses) and the outward normal there."""
        offset = rays.origins - torch.tensor(self.centre)
        half = (offset * rays.directions).sum(1)
        inside = half**2 - (offset * offset).sum(1) + self.radius**2
        t = torch.where(inside >= 0, -half - inside.clamp_min(0).sqrt(), math.inf)
        t = torch.where(t > 0, t, math.inf)
        points = rays.origins + rays.directions * t.nan_to_num(posinf=0)[:, None]
        return t, (points - torch.tensor(self.centre)) / self.radius

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        centre = torch.tensor(self.centre)
        return torch.stack([centre - self.radius, centre + self.radius])


@dataclass(frozen=True)
class Block:
    """A box along the axes, world units."""

    low: Point
    high: Point
    grain: float = 1.0

    def intersect(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R 3"]]:
        """As `Ball.intersect`."""
        low, high = self.box
        first = (low - rays.origins) / rays.directions
        second = (high - rays.origins) / rays.directions
        enters, axis = torch.minimum(first, second).max(1)
        leaves = torch.maximum(first, second).min(1).values
        t = torch.where((leaves > enters) & (enters > 0), enters, math.inf)
        normals = torch.nn.functional.one_hot(axis, 3).to(t.dtype) * -rays.directions.sign()
        return t, normals

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        return torch.tensor([self.low, self.high])


Body = Ball | Block


def shade(
    points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], grain: Float[Tensor, "N 1"]
) -> Float[Tensor, "N 3"]:
    """Colour of a surface: three waves, lit from one side; finer with larger `grain`, plain for 0."""
    waves = torch.tensor([[5.0, 2.0, 1.0], [-2.0, 6.0, 3.0], [1.0, -3.0, 7.0]])
    colour = 0.5 + 0.35 * torch.sin(grain * points @ waves.T + torch.tensor([0.0, 1.0, 2.0]))
    light = (normals @ torch.tensor(LIGHT)).clamp_min(0)
    return colour * (0.45 + 0.55 * light[:, None])


def trace_rays(bodies: Sequence[Body], rays: Rays) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"], Int[Tensor, "R"]]:
    """Colour, distance and index of the first body along each ray: black, infinite and 0 where there is none."""
    distance, normals = torch.full((len(rays),), math.inf), torch.zeros(len(rays), 3)
    index = torch.zeros(len(rays), dtype=torch.long)
    for i, body in enumerate(bodies):
        t, normal = body.intersect(rays)
        nearer = t < distance
        distance, index = torch.where(nearer, t, distance), index.masked_fill(nearer, i)
        normals = torch.where(nearer[:, None], normal, normals)
    points = rays.origins + rays.directions * distance.nan_to_num(posinf=0)[:, None]
    colour = shade(points, normals, torch.tensor([body.grain for body in bodies])[index, None])
    return torch.where(distance.isfinite()[:, None], colour, 0.0), distance, index


def render_photos(
    bodies: Sequence[Body], cameras: Cameras, background: Point | None, samples: int = 3
) -> UInt8[Tensor, "V H W C"]:
    """Photos on a background, or with alpha where it is None; the mean over `samples` x `samples` rays a pixel."""
    fine = cameras.scaled(samples)
    photos = []
    for view in range(len(cameras)):
        colour, distance, _ = trace_rays(bodies, fine.view_rays(view))
        layers = torch.cat([colour, distance.isfinite()[:, None].float()], dim=1)
        mean = layers.view(cameras.height, samples, cameras.width, samples, 4).mean((1, 3))
        premultiplied, alpha = mean[..., :3], mean[..., 3:]
        if background is None:
            photo = torch.cat([premultiplied / alpha.clamp_min(1e-6), alpha], dim=-1)
        else:
            photo = premultiplied + (1 - alpha) * torch.tensor(background)
        photos.append((photo.clamp(0, 1) * 255).round().to(torch.uint8))
    return torch.stack(photos)


def place_cameras(count: int, size: int, phase: float = 0.0, distance: float = DISTANCE) -> Cameras:
    """Cameras spread over the upper part of a sphere, looking at the origin; `phase` rotates them about z.

    Equal steps in height are equal areas of the sphere; the golden angle between neighbours keeps them apart.
    """
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 0.05 + 0.85 * index / count
    azimuth = index * math.pi * (3 - math.sqrt(5)) + phase
    ring = (1 - z**2).sqrt()
    eye = distance * torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], dim=1)
    c2w = look_at(eye, torch.zeros(3).double(), torch.tensor([0.0, 0.0, 1.0]).double()).float()
    return make_cameras(c2w, size, size, FIELD_OF_VIEW_RAD)


def make_cameras(c2w: Float[Tensor, "V 4 4"], width: int, height: int, field_of_view_rad: float) -> Cameras:
    """Pinhole cameras of one horizontal field of view."""
    focal = 0.5 * width / math.tan(0.5 * field_of_view_rad)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Cameras.of_size(K.repeat(len(c2w), 1, 1), c2w, width, height)


def bound_bodies(bodies: Sequence[Body]) -> Bounds:
    """The box around bodies, a tenth larger."""
    boxes = torch.stack([body.box for body in bodies])
    low, high = boxes[:, 0].amin(0), boxes[:, 1].amax(0)
    centre, half = (low + high) / 2, (high - low) / 2
    return Bounds(torch.stack([centre - 1.1 * half, centre + 1.1 * half]))


def make_scene(
    bodies: Sequence[Body],
    background: Point | None = (0.0, 0.0, 0.0),
    size: int = 40,
    views: int = 24,
    held_out: int = 4,
) -> Scene:
    """A scene of bodies around the origin, with exact cameras and bounds.

    Args:
        bodies: within about 1 of the origin.
        background: baked into the photos; None for photos with alpha.
        size: pixels along each side.
        views, held_out: number of training and held-out views.
    """
    train, val = place_cameras(views, size), place_cameras(held_out, size, phase=0.7)
    return Scene(
        name="toy",
        source=BUILT_IN,
        train=Views.of(render_photos(bodies, train, background), train),
        val=Views.of(render_photos(bodies, val, background), val),
        orbit=place_cameras(8, size, phase=0.3),
        bounds=bound_bodies(bodies),
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
"""Small: three percent of a photo."""
ROD: list[Body] = [Block((-0.02, -0.02, -0.8), (0.02, 0.02, 0.8)), Block((-0.6, -0.6, -0.9), (0.6, 0.6, -0.8))]
"""Thinner than a pixel, on a plate."""
