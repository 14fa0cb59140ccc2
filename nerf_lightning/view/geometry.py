"""What a page about a scene draws, as plain arrays: frusta with photos, rays, samples, lines. Knows no viewer."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays, find_pivot, mean_up
from nerf_lightning.dataset.resize import fit_size, resize_area
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.text import subsample

OVERVIEW_FOV = math.radians(50)
"""Vertical field of view of the browser's camera at first."""
MAX_POINTS, COLOUR_VIEWS = 40_000, 24
"""Points that are shown, and photos that give them colours."""


@dataclass(frozen=True)
class Frustum:
    """A view as a pyramid from the camera's centre to its photo, as if the optical axis met the photo's middle."""

    name: str
    c2w: Float[np.ndarray, "4 4"]
    """OpenCV frame, camera to world."""
    fov: float
    """Vertical field of view, radians."""
    aspect: float
    """Width over height of the pyramid's base."""
    photo: UInt8[np.ndarray, "h w C"]


@dataclass(frozen=True)
class RayFigure:
    """N rays, and M samples on those that meet the bounds; world frame."""

    approach: Float[np.ndarray, "N 2 3"]
    """From each camera to where the ray enters the bounds; a short piece of rays that miss them."""
    inside: Float[np.ndarray, "K 2 3"]
    """From near to far, for the K rays that meet the bounds."""
    samples: Float[np.ndarray, "M 3"]


@dataclass(frozen=True)
class Viewpoint:
    """Where a viewer's camera stands."""

    position: Float[np.ndarray, "3"]
    look_at: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    fov: float
    """Vertical, radians."""


def iterate_frusta(views: Views, photo_side: int) -> Iterator[Frustum]:
    """A frustum for each view, named after its photo, which is reduced to `photo_side` pixels along its longest side."""
    cameras = views.cameras
    for i, (K, c2w) in enumerate(zip(cameras.K.numpy(), cameras.c2w.numpy(), strict=True)):
        width, height = cameras.size(i)
        fov, aspect = 2 * math.atan(height / (2 * K[1, 1])), float(width / K[0, 0] * K[1, 1] / height)
        photo = resize_area(views.image(i).numpy(), *fit_size(width, height, photo_side))
        yield Frustum(views.name(i), c2w, fov, aspect, photo)


def sample_random_rays(cameras: Cameras, view: Int[Tensor, "R"], generator: Generator) -> Rays:
    """The ray of a random pixel of each of some views, which may repeat."""
    place = torch.rand(len(view), 2, generator=generator) * cameras.sizes[view]
    col, row = place.long().minimum(cameras.sizes[view] - 1).unbind(1)
    return cameras.generate_rays(view, row, col)


def build_ray_figure(rays: Rays, bounds: Bounds, samples: int, stump: float) -> RayFigure:
    """Rays and samples in the middle of equal intervals along them.

    Args:
        rays: in the bounds' frame.
        bounds: where the content is.
        samples: intervals on each ray that meets the bounds.
        stump: how much of a ray that misses the bounds is drawn, world units.
    """
    near, far = bounds.near_far(rays)
    hit = far > near

    def along(t: Float[Tensor, "R S"]) -> Float[Tensor, "R S 3"]:
        return rays.origins[:, None] + t[..., None] * rays.directions[:, None]

    shares = (torch.arange(samples) + 0.5) / samples
    entry = torch.where(hit, near, torch.full_like(near, stump))
    return RayFigure(
        along(torch.stack([torch.zeros_like(near), entry], dim=1)).numpy(),
        along(torch.stack([near, far], dim=1))[hit].numpy(),
        along(near[:, None] + shares * (far - near)[:, None])[hit].flatten(0, 1).numpy(),
    )


def colour_points(
    points: Float[Tensor, "P 3"], views: Views
) -> tuple[Float[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"]]:
    """Some of the points of a subject, and for each the colour that it has in the nearest of some photos; grey in none."""
    points = points[subsample(len(points), MAX_POINTS)].float()
    rgb = torch.full((len(points), 3), 128, dtype=torch.uint8)
    nearest = torch.full((len(points),), math.inf)
    for view in subsample(len(views), COLOUR_VIEWS):
        pixels, _, seen = views.cameras.project(points, view)
        distance = (points - views.cameras.centres[view]).norm(dim=1)
        closer = seen & (distance < nearest)
        col, row = pixels[closer].long().unbind(1)
        rgb[closer], nearest[closer] = views.image(view)[row, col, :3], distance[closer]
    return points.numpy(), rgb.numpy()


def compute_box_edges(aabb: Float[Tensor, "2 3"]) -> Float[np.ndarray, "12 2 3"]:
    """The edges of a box given by its lower and upper corner."""
    corners = torch.cartesian_prod(*aabb.T).numpy()
    pairs = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return corners[np.array(pairs)]


def compute_path_segments(cameras: Cameras) -> Float[np.ndarray, "N 2 3"]:
    """The line from view to view, closed if the last view is about as near to the first as to the one before it."""
    centres = cameras.centres.numpy()
    segments = np.stack([centres, np.roll(centres, -1, axis=0)], axis=1)
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    closed = len(segments) > 2 and lengths[-1] <= 1.5 * lengths[:-1].max()
    return segments if closed else segments[:-1]


def get_home_viewpoint(orbit: Cameras) -> tuple[Viewpoint, float]:
    """The first view of an orbit, as a viewer's camera, and its distance from the subject."""
    focus = find_pivot(orbit)
    up = mean_up(orbit)
    distance = float((orbit.centres - focus).norm(dim=1).mean())
    fov = 2 * math.atan(orbit.height / (2 * float(orbit.K[0, 1, 1])))
    home = Viewpoint(orbit.centres[0].numpy(), focus.numpy(), up.numpy(), fov)
    return home, max(distance, 1e-6)


def get_overview_viewpoint(scene: Scene) -> Viewpoint:
    """A view of all cameras and the bounds: from behind the orbit's start."""
    home, _ = get_home_viewpoint(scene.orbit)
    points = torch.cat([scene.train.cameras.centres, scene.val.cameras.centres, scene.bounds.aabb]).numpy()
    reach = max(float(np.linalg.norm(points - home.look_at, axis=1).max()), 1e-6)
    away = home.position - home.look_at
    away *= reach / math.sin(OVERVIEW_FOV / 2) / max(float(np.linalg.norm(away)), 1e-6)
    return Viewpoint(home.look_at + away, home.look_at, home.up, OVERVIEW_FOV)


def get_photo_viewpoint(frustum: Frustum, distance: float, up: Float[np.ndarray, "3"]) -> Viewpoint:
    """The photo's own view, turning about the point `distance` ahead, upright as the photo."""
    right, down, ahead, position = frustum.c2w[:3].T
    level = up - (up @ right) * right  # the scene's up, rolled with the photo, keeps turning level
    if -level @ down < 0.05:
        level = -down
    return Viewpoint(position, position + np.float32(distance) * ahead, level, frustum.fov)
