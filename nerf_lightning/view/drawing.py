"""What a page about a scene draws, as plain arrays: frusta with photos, rays, samples, lines. Knows no viewer."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays, upward
from nerf_lightning.dataset.region import find_region
from nerf_lightning.dataset.resize import area_resize, fit_size
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.sampler import UniformSampler
from nerf_lightning.utils.evenly import evenly

OVERVIEW_FOV = math.radians(50)
"""Vertical field of view of the browser's camera at first."""
OVERVIEW_ELEVATION = math.radians(25)
MAX_POINTS, COLOUR_VIEWS = 40_000, 24
"""Points that are shown, and photos that give them colours."""


@dataclass(frozen=True)
class Frustum:
    """A view as a pyramid from the camera's centre to its photo, which stands centred on the optical axis."""

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


def frusta(views: Views, word: str, photo_side: int) -> Iterator[Frustum]:
    """A frustum for each view.

    Args:
        views: the photos and their cameras.
        word: names are this word and the view's number.
        photo_side: longest side of the photos in pixels.
    """
    cameras = views.cameras
    for i, (K, c2w) in enumerate(zip(cameras.K.double().numpy(), cameras.c2w.numpy(), strict=True)):
        fov, aspect, photo = _centred(views.image(i).numpy(), K, photo_side)
        yield Frustum(f"{word} {i}", c2w, fov, aspect, photo)


def _centred(
    image: UInt8[np.ndarray, "H W C"], K: Float[np.ndarray, "3 3"], photo_side: int
) -> tuple[float, float, UInt8[np.ndarray, "h w C2"]]:
    """A photo, reduced, with the optical axis in its middle; the vertical field of view and the aspect that it then has."""
    height, width = image.shape[:2]
    w, h = fit_size(width, height, photo_side)
    photo = area_resize(image, w, h)
    # Viewers assume that the optical axis meets the middle of the picture: where it does not, add transparent margins.
    half_x, half_y = max(K[0, 2], width - K[0, 2]), max(K[1, 2], height - K[1, 2])
    left, right = ((half_x - side) * w / width for side in (K[0, 2], width - K[0, 2]))
    above, below = ((half_y - side) * h / height for side in (K[1, 2], height - K[1, 2]))
    margins = ((round(above), round(below)), (round(left), round(right)), (0, 0))
    if np.any(margins):
        opaque = np.full((h, w, 1), 255, np.uint8)
        photo = np.pad(photo if photo.shape[2] == 4 else np.concatenate([photo, opaque], axis=2), margins)
    tangent_x, tangent_y = half_x / K[0, 0], half_y / K[1, 1]
    return 2 * math.atan(tangent_y), float(tangent_x / tangent_y), photo


def random_rays(cameras: Cameras, view: Int[Tensor, "R"], generator: Generator) -> Rays:
    """The ray of a random pixel of each of some views, which may repeat."""
    place = torch.rand(len(view), 2, generator=generator) * cameras.sizes[view]
    col, row = place.long().minimum(cameras.sizes[view] - 1).unbind(1)
    return cameras.rays(view, row, col)


def ray_figure(rays: Rays, bounds: Bounds, samples: int, stump: float, generator: Generator | None) -> RayFigure:
    """Rays and the uniform sampler's positions along them.

    Args:
        rays: in the bounds' frame.
        bounds: where the content is.
        samples: intervals on each ray that meets the bounds; their midpoints are drawn.
        stump: how much of a ray that misses the bounds is drawn, world units.
        generator: jitters the intervals, as in training; None leaves them equal.
    """
    sampler = UniformSampler(bounds, samples, stratified=True)
    positions = sampler(rays, _no_density, generator).positions(rays)
    near, far = bounds.near_far(rays)
    hit = far > near

    def along(t: Float[Tensor, "R"]) -> Float[Tensor, "R 3"]:
        return rays.origins + t[:, None] * rays.directions

    entry = along(torch.where(hit, near, torch.full_like(near, stump)))
    return RayFigure(
        torch.stack([rays.origins, entry], dim=1).numpy(),
        torch.stack([along(near), along(far)], dim=1)[hit].numpy(),
        positions.numpy(),
    )


def _no_density(positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
    """Stands in for a field: the uniform sampler never asks for density."""
    raise RuntimeError("a uniform sampler asked for density")


def colour_points(
    points: Float[Tensor, "P 3"], views: Views
) -> tuple[Float[np.ndarray, "N 3"], UInt8[np.ndarray, "N 3"]]:
    """Some of the points of a subject, and for each the colour that it has in the nearest of some photos; grey in none."""
    points = points[evenly(len(points), MAX_POINTS)].float()
    rgb = torch.full((len(points), 3), 128, dtype=torch.uint8)
    nearest = torch.full((len(points),), math.inf)
    for view in evenly(len(views), COLOUR_VIEWS):
        pixels, _, seen = views.cameras.project(points, view)
        distance = (points - views.cameras.centres[view]).norm(dim=1)
        closer = seen & (distance < nearest)
        col, row = pixels[closer].long().unbind(1)
        rgb[closer], nearest[closer] = views.image(view)[row, col, :3], distance[closer]
    return points.numpy(), rgb.numpy()


def box_edges(aabb: Float[Tensor, "2 3"]) -> Float[np.ndarray, "12 2 3"]:
    """The edges of a box given by its lower and upper corner."""
    corners = torch.cartesian_prod(*aabb.T).numpy()
    pairs = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return corners[np.array(pairs)]


def path_segments(cameras: Cameras) -> Float[np.ndarray, "N 2 3"]:
    """The line from view to view, closed if the last view is about as near to the first as to the one before it."""
    centres = cameras.centres.numpy()
    segments = np.stack([centres, np.roll(centres, -1, axis=0)], axis=1)
    lengths = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    closed = len(segments) > 2 and lengths[-1] <= 1.5 * lengths[:-1].max()
    return segments if closed else segments[:-1]


def scene_scale(scene: Scene) -> float:
    """The cameras' distance to what they look at, in the scene's unit."""
    return find_region(scene.train.cameras.c2w).unit


def overview(scene: Scene) -> Viewpoint:
    """A view of all cameras and the bounds: from behind the orbit's start, upright as the orbit's pictures."""
    focus = find_region(scene.train.cameras.c2w).centre.float()
    up = upward(scene.orbit)
    if float(up.norm()) < 0.5:  # a path that rolls over: no direction is up
        up = torch.tensor([0.0, 0.0, 1.0])
    offset = scene.orbit.centres[0] - focus
    side = offset - (offset @ up) * up
    if float(side.norm()) < 1e-3 * float(offset.norm()):  # it starts right above
        helper = torch.eye(3)[int(up.abs().argmin())]
        side = helper - (helper @ up) * up
    side = torch.nn.functional.normalize(side, dim=0)
    points = torch.cat([scene.train.cameras.centres, scene.val.cameras.centres, scene.bounds.aabb])
    reach = max(float((points - focus).norm(dim=1).max()), 1e-6)
    distance = reach / math.sin(OVERVIEW_FOV / 2)
    position = focus + distance * (math.cos(OVERVIEW_ELEVATION) * side + math.sin(OVERVIEW_ELEVATION) * up)
    return Viewpoint(position.numpy(), focus.numpy(), up.numpy(), OVERVIEW_FOV)


def through(frustum: Frustum, distance: float, up: Float[np.ndarray, "3"]) -> Viewpoint:
    """The photo's own view, turning about the point `distance` ahead, upright as the photo."""
    right, down, ahead, position = frustum.c2w[:3].T
    level = up - (up @ right) * right  # the scene's up, rolled with the photo, keeps turning level
    if -level @ down < 0.05:
        level = -down
    return Viewpoint(position, position + np.float32(distance) * ahead, level, frustum.fov)
