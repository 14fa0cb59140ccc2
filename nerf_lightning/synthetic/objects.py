"""Ray-traced scenes of spheres and boxes with a smooth pattern, on any background, rendered in a fraction of a second."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays, look_at
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views

CAMERA_DISTANCE = 4.0
"""Distance of the cameras from the origin, world units."""
FIELD_OF_VIEW_RAD = 0.7  # horizontal
LIGHT_DIRECTION = (0.5, -0.4, 0.77)
"""Direction toward the light, nearly unit length."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Sphere:
    """A sphere, world units."""

    center: Point
    radius: float
    frequency: float = 1.0
    """Spatial frequency of the pattern, see `shade`."""

    def intersect(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R 3"]]:
        """Distance along each ray to the surface (inf if it misses) and the outward normal there."""
        offset = rays.origins - torch.tensor(self.center)
        half = (offset * rays.directions).sum(1)
        inside = half**2 - (offset * offset).sum(1) + self.radius**2
        t = torch.where(inside >= 0, -half - inside.clamp_min(0).sqrt(), math.inf)
        t = torch.where(t > 0, t, math.inf)
        points = rays.origins + rays.directions * t.nan_to_num(posinf=0)[:, None]
        return t, (points - torch.tensor(self.center)) / self.radius

    @property
    def aabb(self) -> Float[Tensor, "2 3"]:
        center = torch.tensor(self.center)
        return torch.stack([center - self.radius, center + self.radius])


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, world units."""

    low: Point
    high: Point
    frequency: float = 1.0

    def intersect(self, rays: Rays) -> tuple[Float[Tensor, "R"], Float[Tensor, "R 3"]]:
        """Distance and outward normal, see `Sphere.intersect`."""
        low, high = self.aabb
        first = (low - rays.origins) / rays.directions
        second = (high - rays.origins) / rays.directions
        t_enter, axis = torch.minimum(first, second).max(1)
        t_exit = torch.maximum(first, second).min(1).values
        t = torch.where((t_exit > t_enter) & (t_enter > 0), t_enter, math.inf)
        normals = torch.nn.functional.one_hot(axis, 3).to(t.dtype) * -rays.directions.sign()
        return t, normals

    @property
    def aabb(self) -> Float[Tensor, "2 3"]:
        return torch.tensor([self.low, self.high])


Primitive = Sphere | Box


def shade(
    points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], frequency: Float[Tensor, "N 1"]
) -> Float[Tensor, "N 3"]:
    """Surface color: three sine waves scaled by `frequency` (constant for 0), with Lambertian shading."""
    waves = torch.tensor([[5.0, 2.0, 1.0], [-2.0, 6.0, 3.0], [1.0, -3.0, 7.0]])
    color = 0.5 + 0.35 * torch.sin(frequency * points @ waves.T + torch.tensor([0.0, 1.0, 2.0]))
    light = (normals @ torch.tensor(LIGHT_DIRECTION)).clamp_min(0)
    return color * (0.45 + 0.55 * light[:, None])


def trace_rays(
    primitives: Sequence[Primitive], rays: Rays
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R"], Int[Tensor, "R"]]:
    """Color, distance and index of the first primitive along each ray: black, inf and 0 if there is none."""
    distance, normals = torch.full((len(rays),), math.inf), torch.zeros(len(rays), 3)
    index = torch.zeros(len(rays), dtype=torch.long)
    for i, primitive in enumerate(primitives):
        t, normal = primitive.intersect(rays)
        nearer = t < distance
        distance, index = torch.where(nearer, t, distance), index.masked_fill(nearer, i)
        normals = torch.where(nearer[:, None], normal, normals)
    points = rays.origins + rays.directions * distance.nan_to_num(posinf=0)[:, None]
    color = shade(points, normals, torch.tensor([primitive.frequency for primitive in primitives])[index, None])
    return torch.where(distance.isfinite()[:, None], color, 0.0), distance, index


def render_photos(
    primitives: Sequence[Primitive], cameras: Cameras, background: Point | None, samples: int = 3
) -> UInt8[Tensor, "V H W C"]:
    """Renders photos on a background, or with alpha if it is None; `samples` x `samples` rays per pixel."""
    fine = cameras.rescale(samples)
    photos = []
    for view in range(len(cameras)):
        color, distance, _ = trace_rays(primitives, fine.generate_view_rays(view))
        layers = torch.cat([color, distance.isfinite()[:, None].float()], dim=1)
        mean = layers.view(cameras.height, samples, cameras.width, samples, 4).mean((1, 3))
        premultiplied, alpha = mean[..., :3], mean[..., 3:]
        if background is None:
            photo = torch.cat([premultiplied / alpha.clamp_min(1e-6), alpha], dim=-1)
        else:
            photo = premultiplied + (1 - alpha) * torch.tensor(background)
        photos.append((photo.clamp(0, 1) * 255).round().to(torch.uint8))
    return torch.stack(photos)


def make_hemisphere_cameras(count: int, size: int, phase: float = 0.0, distance: float = CAMERA_DISTANCE) -> Cameras:
    """Cameras on a Fibonacci lattice of the upper hemisphere, looking at the origin; `phase` rotates them about z.

    Equal steps in height are equal areas of the sphere; consecutive azimuths differ by the golden angle.
    """
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 0.05 + 0.85 * index / count
    azimuth = index * math.pi * (3 - math.sqrt(5)) + phase
    ring = (1 - z**2).sqrt()
    eye = distance * torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], dim=1)
    c2w = look_at(eye, torch.zeros(3).double(), torch.tensor([0.0, 0.0, 1.0]).double()).float()
    return make_pinhole_cameras(c2w, size, size, FIELD_OF_VIEW_RAD)


def make_pinhole_cameras(c2w: Float[Tensor, "V 4 4"], width: int, height: int, field_of_view_rad: float) -> Cameras:
    """Pinhole cameras with a common horizontal field of view."""
    focal = 0.5 * width / math.tan(0.5 * field_of_view_rad)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Cameras.pinhole(K.repeat(len(c2w), 1, 1), c2w, width, height)


def bound_primitives(primitives: Sequence[Primitive]) -> Bounds:
    """Bounds of primitives, enlarged by 10 %."""
    boxes = torch.stack([primitive.aabb for primitive in primitives])
    low, high = boxes[:, 0].amin(0), boxes[:, 1].amax(0)
    center, half = (low + high) / 2, (high - low) / 2
    return Bounds(torch.stack([center - 1.1 * half, center + 1.1 * half]))


def make_object_scene(
    primitives: Sequence[Primitive],
    background: Point | None = (0.0, 0.0, 0.0),
    size: int = 40,
    views: int = 24,
    held_out: int = 4,
) -> Scene:
    """A scene of primitives around the origin, with exact cameras and bounds.

    Args:
        primitives: within about 1 of the origin.
        background: baked into the photos; None for photos with alpha.
        size: pixels along each side.
        views, held_out: number of training and held-out views.
    """
    train, val = make_hemisphere_cameras(views, size), make_hemisphere_cameras(held_out, size, phase=0.7)
    return Scene(
        name="toy",
        source=BUILT_IN,
        train=Views.from_images(render_photos(primitives, train, background), train),
        val=Views.from_images(render_photos(primitives, val, background), val),
        orbit=make_hemisphere_cameras(8, size, phase=0.3),
        bounds=bound_primitives(primitives),
        background=background or (0.0, 0.0, 0.0),
    )


PILE: list[Primitive] = [
    Sphere((0.3, 0.2, 0.1), 0.55),
    Sphere((-0.5, -0.3, 0.0), 0.4),
    Box((-0.8, 0.2, -0.4), (-0.2, 0.8, 0.3)),
    Box((-0.9, -0.9, -0.6), (0.9, 0.9, -0.4)),
]
"""Default scene of the stability suite."""
MARBLE: list[Primitive] = [Sphere((0.0, 0.0, 0.0), 0.3)]
"""A small subject: three percent of a photo."""
ROD: list[Primitive] = [Box((-0.02, -0.02, -0.8), (0.02, 0.02, 0.8)), Box((-0.6, -0.6, -0.9), (0.6, 0.6, -0.8))]
"""A rod thinner than a pixel, on a plate."""
