"""Viewer geometry as plain arrays: frusta with photos, rays, samples and lines. Independent of Viser."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays, find_pivot, mean_up, start_at_middle
from nerf_lightning.dataset.resize import fit_size, resize_area
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.text import subsample

OVERVIEW_FOV = math.radians(50)
"""Vertical field of view of the overview, radians."""
MAX_POINTS, COLOR_VIEWS = 40_000, 24
"""Limits for displayed points, and for photos that color them."""


@dataclass(frozen=True)
class Frustum:
    """A camera frustum with its photo; assumes a centered principal point."""

    name: str
    c2w: Float[np.ndarray, "4 4"]
    """OpenCV frame, camera to world."""
    fov: float
    """Vertical field of view, radians."""
    aspect: float
    """Width over height."""
    photo: UInt8[np.ndarray, "h w C"]


@dataclass(frozen=True)
class RayFigure:
    """Line segments of N rays and their M samples, world frame."""

    approach: Float[np.ndarray, "N 2 3"]
    """From each camera to the entry into the bounds; a short stump of rays that miss them."""
    inside: Float[np.ndarray, "K 2 3"]
    """From near to far, for the K rays that hit the bounds."""
    samples: Float[np.ndarray, "M 3"]


@dataclass(frozen=True)
class Viewpoint:
    """Pose and field of view of the viewer's camera."""

    position: Float[np.ndarray, "3"]
    look_at: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    fov: float
    """Vertical, radians."""


def iterate_frusta(views: Views, photo_side: int) -> Iterator[Frustum]:
    """Yields the frustum of each view, with its photo scaled down to `photo_side` pixels."""
    cameras = views.cameras
    for i, (K, c2w) in enumerate(zip(cameras.K.numpy(), cameras.c2w.numpy(), strict=True)):
        width, height = cameras.size(i)
        fov, aspect = 2 * math.atan(height / (2 * K[1, 1])), float(width / K[0, 0] * K[1, 1] / height)
        photo = resize_area(views.image(i).numpy(), *fit_size(width, height, photo_side))
        yield Frustum(views.name(i), c2w, fov, aspect, photo)


def sample_random_rays(cameras: Cameras, view: Int[Tensor, "R"], generator: Generator) -> Rays:
    """Samples a ray through a random pixel of each view in `view`, which may repeat."""
    position = torch.rand(len(view), 2, generator=generator) * cameras.sizes[view]
    col, row = position.long().minimum(cameras.sizes[view] - 1).unbind(1)
    return cameras.generate_rays(view, row, col)


def build_ray_figure(rays: Rays, bounds: Bounds, samples: int, stump: float) -> RayFigure:
    """Line segments of rays, and samples at the midpoints of equal intervals.

    Args:
        rays: world frame.
        bounds: scene bounds.
        samples: per ray that hits the bounds.
        stump: drawn length of a ray that misses the bounds, world units.
    """
    near, far = bounds.near_far(rays)
    hit = far > near

    def compute_points(t: Float[Tensor, "R S"]) -> Float[Tensor, "R S 3"]:
        return rays.origins[:, None] + t[..., None] * rays.directions[:, None]

    fractions = (torch.arange(samples) + 0.5) / samples
    entry = torch.where(hit, near, torch.full_like(near, stump))
    return RayFigure(
        compute_points(torch.stack([torch.zeros_like(near), entry], dim=1)).numpy(),
        compute_points(torch.stack([near, far], dim=1))[hit].numpy(),
        compute_points(near[:, None] + fractions * (far - near)[:, None])[hit].flatten(0, 1).numpy(),
    )


def color_points(
    points: Float[Tensor, "P 3"], views: Views
) -> tuple[Float[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"]]:
    """Subsamples points and colors each from the closest photo that sees it; gray if none does."""
    points = points[subsample(len(points), MAX_POINTS)].float()
    rgb = torch.full((len(points), 3), 128, dtype=torch.uint8)
    nearest = torch.full((len(points),), math.inf)
    for view in subsample(len(views), COLOR_VIEWS):
        pixels, _, seen = views.cameras.project(points, view)
        distance = (points - views.cameras.centers[view]).norm(dim=1)
        closer = seen & (distance < nearest)
        col, row = pixels[closer].long().unbind(1)
        rgb[closer], nearest[closer] = views.image(view)[row, col, :3], distance[closer]
    return points.numpy(), rgb.numpy()


def compute_box_edges(aabb: Float[Tensor, "2 3"]) -> Float[np.ndarray, "12 2 3"]:
    """Edges of a box given by its lower and upper corner."""
    corners = torch.cartesian_prod(*aabb.T).numpy()
    pairs = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return corners[np.array(pairs)]


def compute_path_segments(cameras: Cameras) -> Float[np.ndarray, "N 2 3"]:
    """Segments between consecutive views; closed if the last is about as close to the first as to its predecessor."""
    centers = cameras.centers.numpy()
    segments = np.stack([centers, np.roll(centers, -1, axis=0)], axis=1)
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    closed = len(segments) > 2 and lengths[-1] <= 1.5 * lengths[:-1].max()
    return segments if closed else segments[:-1]


def get_home_viewpoint(orbit: Cameras) -> tuple[Viewpoint, float]:
    """The middle of an orbit as a viewpoint, and the mean distance to its focus."""
    orbit = start_at_middle(orbit)
    focus = find_pivot(orbit)
    up = mean_up(orbit)
    distance = float((orbit.centers - focus).norm(dim=1).mean())
    fov = 2 * math.atan(orbit.height / (2 * float(orbit.K[0, 1, 1])))
    home = Viewpoint(orbit.centers[0].numpy(), focus.numpy(), up.numpy(), fov)
    return home, max(distance, 1e-6)


def get_overview_viewpoint(scene: Scene) -> Viewpoint:
    """A viewpoint behind the orbit's middle that shows all cameras and the bounds."""
    home, _ = get_home_viewpoint(scene.orbit)
    points = torch.cat([scene.train.cameras.centers, scene.val.cameras.centers, scene.bounds.aabb]).numpy()
    radius = max(float(np.linalg.norm(points - home.look_at, axis=1).max()), 1e-6)
    offset = home.position - home.look_at
    offset *= radius / math.sin(OVERVIEW_FOV / 2) / max(float(np.linalg.norm(offset)), 1e-6)
    return Viewpoint(home.look_at + offset, home.look_at, home.up, OVERVIEW_FOV)


def get_photo_viewpoint(frustum: Frustum, distance: float, up: Float[np.ndarray, "3"]) -> Viewpoint:
    """The viewpoint of a photo, orbiting about the point `distance` ahead."""
    right, down, ahead, position = frustum.c2w[:3].T
    level = up - (up @ right) * right  # the scene's up, rolled with the photo, keeps the orbit level
    if -level @ down < 0.05:
        level = -down
    return Viewpoint(position, position + np.float32(distance) * ahead, level, frustum.fov)
