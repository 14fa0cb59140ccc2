"""From posed photos to a scene: one frame and one unit, split, bounds and an orbit, the same for every format."""

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
    Cameras,
    estimate_up,
    has_panoramas,
    make_orbit_path,
    rotation_to_z_up,
    transform_points,
    transform_poses,
)
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
NEAR_FRACTION = 0.25
"""Sampling starts at this share of the nearest camera's distance to what all look at, where they look at one thing."""
CONTENT_NEAR_FRACTION = 0.7
"""Or at this share of the nearest known content's distance, if that is less."""
MAX_NEAR_POINTS, OUTLIER_QUANTILE = 4096, 0.01
"""Points that are looked at, and the share of a view's that may be wrong."""


@dataclass(frozen=True)
class Split:
    """Indices of photos."""

    train: list[int]
    val: list[int]
    """Held out: measured on while training and at its end."""
    test: list[int] = field(default_factory=list)
    """Held out and measured on at the end alone, where a format has both."""


@dataclass(frozen=True)
class Hints:
    """What a file says about its scene beside photos and poses."""

    alpha_background: tuple[float, float, float] = BLACK
    """What photos with alpha are composited on."""
    keep_frame: bool = False
    """Whether the scene of a bounded subject keeps the file's frame and unit."""
    camera_path: Cameras | None = None
    """Cameras to show the result along, in the file's frame."""
    nearest_depth: float | None = None
    """Distance of the nearest content to a camera, in the file's unit."""
    points: Float[np.ndarray, "P 3"] | None = None
    """On surfaces, in the file's frame."""
    background: tuple[float, float, float] | None = None
    """Colour behind the subject, where the file states it."""
    bounds: Bounds | None = None
    """The box that the file states, in its frame: a scene with one stays there."""
    near: float | None = None
    far: float | None = None
    """Distances along the rays, in the file's unit."""
    to_source: Float[np.ndarray, "4 4"] | None = None
    """Similarity from the file's frame to that of its own original."""


def split_photos(source: Path, count: int, holdout: int) -> Split:
    """Every `holdout`-th photo is held out."""
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
        source: what the user named, for messages.
        name: of the scene.
        shots: in the order of the format.
        options: see there.
        split: None holds out every `options.holdout`-th.
        hints: what else the file says.

    Raises:
        InputError: nothing to train on or to hold out, or photos that cannot be read.
    """
    split = split or split_photos(source, len(photos), options.holdout)
    checks.check_split_size(source, "train split", len(split.train))
    checks.check_split_size(source, "val split", len(split.val))
    # Part after part, so that none of them needs a copy of its pixels.
    views = load_views(source, [photos[i] for part in (split.train, split.val, split.test) for i in part], options)
    parts = []
    for part in torch.arange(len(views)).split([len(split.train), len(split.val), len(split.test)]):
        if views.valid_mask is not None:
            shown = torch.tensor([bool(views.view_mask(view).any()) for view in part.tolist()], dtype=torch.bool)
            if not shown.all():
                log.warning("%s: %d photos are masked entirely: left out", source, int((~shown).sum()))
            part = part[shown]
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
    """Places read photos in one frame and decides what kind of scene they show, the same for every format.

    The world is moved to the region that the training photos show (see `find_region`), turned so that z points up (see
    `cameras.estimate_up`), and scaled so that this region is the cube [-1, 1]^3, the box of an unbounded one; `to_source` leads
    back. A bounded scene with `hints.keep_frame` stays where it is instead.

    `parts` are training and held-out photos, and those that are measured on at the end alone, where there are any; with
    double-precision poses in the file's frame and unit. For the other arguments see `build_scene`.
    """
    train = parts[0]
    check_visible_pixels(source, train)
    kind = classify_scene(train, options.bounded, options.masked, hints.alpha_background)
    if hints.bounds is not None and options.bounded == "auto":
        kind = replace(kind, bounded=not hints.bounds.unbounded, reason="the file states a box")
    if hints.background is not None:
        kind = replace(kind, background=hints.background)
    region = locate_region(source, train, hints)
    text = "%s: taken as %s, since %s (dataset.bounded overrides); %s cameras"
    log.info(text, name, "bounded" if kind.bounded else "unbounded", kind.reason, region.layout)
    if not region.has_depth and not kind.bounded:
        text = (
            "%s: %s cameras, and neither poses nor points tell how far away what they see is: %.3g, in the file's unit?"
        )
        log.warning(text, source, region.layout, region.unit)
    keeps_frame = hints.keep_frame and kind.bounded and is_float32_precise(train.cameras, region)
    to_source = torch.eye(4, dtype=torch.float64)
    if hints.bounds is None and not keeps_frame:
        to_source = make_region_frame(train.cameras.c2w, region)
    from_source = torch.linalg.inv(to_source)

    def move(cameras: Cameras) -> Cameras:
        return replace(cameras, c2w=transform_poses(cameras.c2w, from_source).float())

    placed = [replace(apply_alpha(part, kind.is_cutout), cameras=move(part.cameras)) for part in parts]
    centre = transform_points(from_source, region.centre.double()).float()
    orbit = (
        make_orbit_path(placed[0].cameras, region.layout, centre)
        if hints.camera_path is None
        else move(hints.camera_path)
    )
    return Scene(
        name=name.lower(),
        source=str(source),
        train=placed[0],
        val=placed[1],
        test=placed[2] if placed[2:] else None,
        orbit=orbit,
        bounds=find_bounds(placed[0], kind, from_source, hints, region),
        background=kind.background,
        to_source=to_source if hints.to_source is None else torch.from_numpy(hints.to_source) @ to_source,
        kind=f"{kind.reason}; {region.layout} cameras",
        points=None if region.points is None else transform_points(from_source, region.points).float(),
    )


def locate_region(source: Path, views: Views, hints: Hints) -> Region:
    """The region that training photos show, see `find_region`."""
    points = None if hints.points is None else torch.from_numpy(hints.points)
    region = find_region(
        list_viewing_poses(views.cameras), points, lambda: triangulate_matches(views, views.cameras.c2w.numpy())
    )
    if not checks.MIN_CAMERA_DISTANCE <= region.unit <= checks.MAX_COORDINATE:
        expected = f"a distance of {checks.MIN_CAMERA_DISTANCE:g} to {checks.MAX_COORDINATE:g}"
        found = f"cameras {region.unit:.3g} from what they look at"
        raise InputError(source, "poses", found, expected, "take another unit")
    return region


def is_float32_precise(cameras: Cameras, region: Region) -> bool:
    """Whether single precision tells pixels apart in the file's frame: not where its origin is far away, as of georeferenced
    files."""
    return checks.FLOAT32_EPS * float(cameras.centres.abs().max()) <= region.unit / float(cameras.K[:, 0, 0].median())


def find_bounds(
    views: Views, kind: SceneKind, from_source: Float[Tensor, "4 4"], hints: Hints, region: Region
) -> Bounds:
    """The box that the file states, or that silhouettes give; of an unbounded scene the cube [-1, 1]^3.

    There sampling starts before the nearest content that is known, or what cameras look at.
    """
    scale = float(torch.linalg.det(from_source[:3, :3])) ** (1 / 3)
    near, far = (None if x is None else x * scale for x in (hints.near, hints.far))
    if hints.bounds is not None:
        return replace(hints.bounds, near=near, far=far)
    if kind.bounded:
        return estimate_bounds(views, kind.background, near, far)
    starts = [] if hints.nearest_depth is None else [CONTENT_NEAR_FRACTION * (hints.nearest_depth * scale)]
    if hints.points is not None and len(hints.points):
        starts.append(
            CONTENT_NEAR_FRACTION
            * find_nearest_distance(transform_points(from_source, torch.from_numpy(hints.points)).float(), views)
        )
    if region.has_subject:
        starts.append(NEAR_FRACTION * min(1.0, float(views.cameras.centres.norm(dim=1).min())))
    near = min(starts, default=None) if near is None else near
    return Bounds(torch.tensor([[-1.0] * 3, [1.0] * 3]), unbounded=True, near=near, far=far)


def list_viewing_poses(cameras: Cameras) -> Float[Tensor, "W 4 4"]:
    """Poses whose axes say where cameras look: of a photo of all directions, four around its vertical axis."""
    if not has_panoramas(cameras):
        return cameras.c2w
    quarter = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    return torch.cat([cameras.c2w @ torch.linalg.matrix_power(quarter, turns) for turns in range(4)])


def find_nearest_distance(points: Float[Tensor, "P 3"], views: Views) -> float:
    """Distance of the nearest points to the camera that sees them, stray ones aside; infinite where none sees any."""
    some = points[:: -(-len(points) // MAX_NEAR_POINTS)]
    found = [math.inf]
    for view in range(len(views)):
        distance = (some - views.cameras.centres[view]).norm(dim=1)[views.cameras.project(some, view)[2]]
        if len(distance):
            found.append(float(distance.quantile(OUTLIER_QUANTILE)))
    return min(found)


def make_region_frame(c2w: Float[Tensor, "V 4 4"], region: Region) -> Float[Tensor, "4 4"]:
    """The similarity from a frame centred on a region, in its unit, with what is up in the photos along z, to theirs."""
    to_source = torch.eye(4, dtype=torch.float64)
    to_source[:3, :3] = region.unit * rotation_to_z_up(estimate_up(c2w)).mT
    to_source[:3, 3] = region.centre
    return to_source
