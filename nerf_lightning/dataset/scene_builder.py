"""Builds a Scene from posed photos of any format: world frame, split, bounds and orbit."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import (
    Bounds,
    CameraLayout,
    Cameras,
    estimate_up,
    has_panoramas,
    make_orbit_path,
    rotation_to_z_up,
    transform_points,
    transform_poses,
)
from nerf_lightning.cameras.bounds import UNBOUNDED_FAR_HALF_SIZES
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.matching.triangulation import triangulate_matches
from nerf_lightning.dataset.photo_loading import PhotoLoadOptions, PosedPhoto, load_views
from nerf_lightning.dataset.region import Region, find_region
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.scene_bounds import estimate_bounds
from nerf_lightning.dataset.scene_kind import SceneKind, apply_alpha, check_visible_pixels, classify_scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

BLACK = (0.0, 0.0, 0.0)
CONTENT_NEAR_FRACTION = 0.7
"""Near plane as a fraction of the nearest known content's distance."""
NEAR_FRACTION, MAX_NEAR_FRACTION = 0.25, 0.5
"""Near plane without known content, and farthest with it, as fractions of the nearest camera's distance to the common
subject, which may have few points."""
MAX_CORE_HALF_SIZE = 0.5
"""Half-size of a core, in distances to the subject, from which perspective spacing gains nothing."""
MAX_NEAR_POINTS, OUTLIER_QUANTILE = 4096, 0.01
"""Points used for the near plane, and the fraction per view treated as outliers."""


@dataclass(frozen=True)
class Split:
    """Photo indices of each split."""

    train: list[int]
    val: list[int]
    """Held out: evaluated during training and at its end."""
    test: list[int] = field(default_factory=list)
    """Held out: evaluated only at the end, if the format has both splits."""


@dataclass(frozen=True)
class Hints:
    """Optional scene properties stated by the file."""

    alpha_background: tuple[float, float, float] = BLACK
    """Background for photos with alpha."""
    keep_frame: bool = False
    """Whether a bounded scene keeps the file's frame and unit."""
    camera_path: Cameras | None = None
    """Camera path for videos, in the file's frame."""
    nearest_depth: float | None = None
    """Depth of the nearest content, in the file's unit."""
    points: Float[np.ndarray, "P 3"] | None = None
    """Surface points, in the file's frame."""
    background: tuple[float, float, float] | None = None
    """Background color."""
    bounds: Bounds | None = None
    """Box in the file's frame, which the scene then keeps."""
    near: float | None = None
    far: float | None = None
    """Near and far plane, in the file's unit."""
    to_source: Float[np.ndarray, "4 4"] | None = None
    """Similarity from the file's frame to its source's."""


def split_photos(source: Path, count: int, holdout: int) -> Split:
    """Holds out every `holdout`-th photo."""
    checks.check_split_size(source, "train split", count - len(range(0, count, holdout)))
    return Split([i for i in range(count) if i % holdout], list(range(0, count, holdout)))


def build_scene(
    source: Path,
    name: str,
    photos: Sequence[PosedPhoto],
    options: PhotoLoadOptions,
    split: Split | None = None,
    hints: Hints = Hints(),  # noqa: B008  (frozen)
) -> Scene:
    """Reads posed photos and builds their scene, see `assemble_scene`.

    Args:
        source: path given by the user, for messages.
        name: scene name.
        photos: in the order of the format.
        options: how to read photos.
        split: None holds out every `options.holdout`-th.
        hints: other properties stated by the file.

    Raises:
        InputError: an empty train or val split, or unreadable photos.
    """
    split = split or split_photos(source, len(photos), options.holdout)
    checks.check_split_size(source, "train split", len(split.train))
    checks.check_split_size(source, "val split", len(split.val))
    # Ordered by split, so that each split is a slice without a copy.
    views = load_views(source, [photos[i] for part in (split.train, split.val, split.test) for i in part], options)
    parts = []
    for part in torch.arange(len(views)).split([len(split.train), len(split.val), len(split.test)]):
        if views.valid_mask is not None:
            visible = torch.tensor([bool(views.view_mask(view).any()) for view in part.tolist()], dtype=torch.bool)
            if not visible.all():
                log.warning("%s: %d fully masked photos ignored", source, int((~visible).sum()))
            part = part[visible]
        parts.append(views[part])
    train, val, test = parts
    checks.check_split_size(source, "val split", len(val))
    return assemble_scene(source, name, [train, val, *([test] if len(test) else [])], options, hints)


def assemble_scene(
    source: Path,
    name: str,
    parts: Sequence[Views],
    options: PhotoLoadOptions,
    hints: Hints = Hints(),  # noqa: B008  (frozen)
) -> Scene:
    """Normalizes the world frame of posed photos and classifies the scene.

    The world is translated, rotated (z up, see `cameras.estimate_up`) and scaled so that the region of interest (see
    `find_region`) is the cube [-1, 1]^3, the box of an unbounded scene; `to_source` is the inverse. A bounded scene with
    `hints.keep_frame` keeps its frame.

    `parts` are the train, val and optionally test photos, with float64 poses in the file's frame and unit. For the other
    arguments see `build_scene`.
    """
    train = parts[0]
    check_visible_pixels(source, train)
    kind = classify_scene(train, options.bounded, options.masked, hints.alpha_background)
    if hints.bounds is not None and options.bounded == "auto":
        kind = replace(kind, bounded=not hints.bounds.unbounded, reason="the file states a box")
    if hints.background is not None:
        kind = replace(kind, background=hints.background)
    region = locate_region(source, train, hints)
    if not region.has_depth and not kind.bounded:
        text = "%s: %s cameras, and neither poses nor points determine the depth; assuming %.3g in the file's unit"
        log.warning(text, source, region.layout, region.unit)
    keeps_frame = hints.keep_frame and kind.bounded and is_float32_precise(train.cameras, region)
    to_source = torch.eye(4, dtype=torch.float64)
    if hints.bounds is None and not keeps_frame:
        to_source = make_region_frame(train.cameras.c2w, region)
    from_source = torch.linalg.inv(to_source)

    def move(cameras: Cameras) -> Cameras:
        return replace(cameras, c2w=transform_poses(cameras.c2w, from_source).float())

    splits = [replace(apply_alpha(part, kind.is_cutout), cameras=move(part.cameras)) for part in parts]
    center = transform_points(from_source, region.center.double()).float()
    bounds = find_bounds(splits[0], kind, from_source, hints, region)
    text = "%s: %s scene, since %s (dataset.bounded overrides); %s cameras%s"
    spacing = "" if bounds.core is None else ", detail spaced in perspective and disparity"
    log.info(text, name, "bounded" if kind.bounded else "unbounded", kind.reason, region.layout, spacing)
    path = hints.camera_path
    orbit = make_orbit_path(splits[0].cameras, region.layout, center) if path is None else move(path)
    return Scene(
        name=name.lower(),
        source=str(source),
        train=splits[0],
        val=splits[1],
        test=splits[2] if splits[2:] else None,
        orbit=orbit,
        bounds=bounds,
        background=kind.background,
        to_source=to_source if hints.to_source is None else torch.from_numpy(hints.to_source) @ to_source,
        kind=f"{kind.reason}; {region.layout} cameras",
        points=None if region.points is None else transform_points(from_source, region.points).float(),
    )


def locate_region(source: Path, views: Views, hints: Hints) -> Region:
    """Finds the region of interest of the training photos, see `find_region`."""
    points = None if hints.points is None else torch.from_numpy(hints.points)
    poses, c2w = list_viewing_poses(views.cameras), views.cameras.c2w.numpy()
    region = find_region(poses, points, lambda: triangulate_matches(views, c2w))
    if not checks.MIN_CAMERA_DISTANCE <= region.unit <= checks.MAX_COORDINATE:
        expected = f"a distance of {checks.MIN_CAMERA_DISTANCE:g} to {checks.MAX_COORDINATE:g}"
        found = f"cameras {region.unit:.3g} from their subject"
        raise InputError(source, "poses", found, expected, "change the unit")
    return region


def is_float32_precise(cameras: Cameras, region: Region) -> bool:
    """Whether float32 resolves pixels in the file's frame, unlike in georeferenced ones with a distant origin."""
    return checks.FLOAT32_EPS * float(cameras.centers.abs().max()) <= region.unit / float(cameras.K[:, 0, 0].median())


def find_bounds(
    views: Views, kind: SceneKind, from_source: Float[Tensor, "4 4"], hints: Hints, region: Region
) -> Bounds:
    """Bounds from the file or the silhouettes; for an unbounded scene the cube [-1, 1]^3, with a near plane in front of the
    nearest known content, without any in front of the subject."""
    scale = float(torch.linalg.det(from_source[:3, :3])) ** (1 / 3)
    near, far = (None if x is None else x * scale for x in (hints.near, hints.far))
    if hints.bounds is not None:
        return replace(hints.bounds, near=near, far=far)
    if kind.bounded:
        return estimate_bounds(views, kind.background, near, far)
    nearest = math.inf if hints.nearest_depth is None else hints.nearest_depth * scale
    if hints.points is not None and len(hints.points):
        points = transform_points(from_source, torch.from_numpy(hints.points)).float()
        nearest = min(nearest, find_nearest_distance(points, views))
    subject = min(1.0, float(views.cameras.centers.norm(dim=1).min())) if region.has_subject else math.inf
    if near is None and nearest < math.inf:
        near = min(CONTENT_NEAR_FRACTION * nearest, MAX_NEAR_FRACTION * subject)
    elif near is None and subject < math.inf:
        near = NEAR_FRACTION * subject
    core = find_core(views.cameras, min(near or 1.0, NEAR_FRACTION)) if region.layout == CameraLayout.FORWARD else None
    if core is not None and far is None:
        far = UNBOUNDED_FAR_HALF_SIZES  # of the box, not of the core
    return Bounds(torch.tensor([[-1.0] * 3, [1.0] * 3]), unbounded=True, near=near, far=far, core=core)


def find_core(cameras: Cameras, near: float) -> Float[Tensor, "2 3"] | None:
    """Finds the core of forward-facing cameras in the region's frame, see `Bounds.core`: a cube around all of them up to the
    near plane; None if that is as large as half the region's."""
    low, high = cameras.centers.amin(0), cameras.centers.amax(0)
    center, half = (low + high) / 2, max(near, float((high - low).max()) / 2)
    return torch.stack([center - half, center + half]) if half < MAX_CORE_HALF_SIZE else None


def list_viewing_poses(cameras: Cameras) -> Float[Tensor, "W 4 4"]:
    """Lists poses whose axes are viewing directions: four around the vertical axis for a panorama."""
    if not has_panoramas(cameras):
        return cameras.c2w
    quarter_turn = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    return torch.cat([cameras.c2w @ torch.linalg.matrix_power(quarter_turn, turns) for turns in range(4)])


def find_nearest_distance(points: Float[Tensor, "P 3"], views: Views) -> float:
    """Smallest distance of a point to a camera that sees it, without outliers; infinite if none is visible."""
    points = points[:: -(-len(points) // MAX_NEAR_POINTS)]
    nearest = [math.inf]
    for view in range(len(views)):
        distance = (points - views.cameras.centers[view]).norm(dim=1)[views.cameras.project(points, view)[2]]
        if len(distance):
            nearest.append(float(distance.quantile(OUTLIER_QUANTILE)))
    return min(nearest)


def make_region_frame(c2w: Float[Tensor, "V 4 4"], region: Region) -> Float[Tensor, "4 4"]:
    """Similarity to the photos' frame from one centered on the region, in its unit, with z up."""
    to_source = torch.eye(4, dtype=torch.float64)
    to_source[:3, :3] = region.unit * rotation_to_z_up(estimate_up(c2w)).mT
    to_source[:3, 3] = region.center
    return to_source
