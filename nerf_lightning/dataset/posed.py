"""From posed photos to a scene: one frame and one unit, split, bounds and an orbit, the same for every format."""

import itertools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import (
    Bounds,
    Cameras,
    has_panoramas,
    held,
    in_other_frame,
    orbit_like,
    transform,
    turn_upright,
)
from nerf_lightning.dataset.extent import estimate_bounds
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.kind import apply_alpha, check_visible, decide_kind
from nerf_lightning.dataset.matching.triangulate import match_points
from nerf_lightning.dataset.region import Region, find_region
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import Reading, Shot, read_shots
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

BLACK = (0.0, 0.0, 0.0)
NEAR = 0.25
"""Sampling starts at this share of the nearest camera's distance to what all look at, where they look at one thing."""
CLEAR = 0.7
"""Or at this share of the nearest known content's distance, if that is less."""
POINTS, STRAY = 4096, 0.01
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
class PosedViews:
    """Photos as they are read, and their poses in the file's frame."""

    views: Views
    """The poses of its cameras do not count."""
    c2w: Float[np.ndarray, "V 4 4"]
    """OpenCV camera to world, the file's frame and unit."""


@dataclass(frozen=True)
class Hints:
    """What a file says about its scene beside photos and poses."""

    alpha_background: tuple[float, float, float] = BLACK
    """What photos with alpha are composited on."""
    keep_frame: bool = False
    """Whether the scene of a bounded subject keeps the file's frame and unit."""
    path: Cameras | None = None
    """Cameras to show the result along, in the file's frame."""
    nearest: float | None = None
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


def split_shots(source: Path, count: int, holdout: int) -> Split:
    """Every `holdout`-th photo is held out."""
    checks.check_split_size(source, "train split", count - len(range(0, count, holdout)))
    return Split([i for i in range(count) if i % holdout], list(range(0, count, holdout)))


def build_scene(
    source: Path,
    name: str,
    shots: Sequence[Shot],
    reading: Reading,
    split: Split | None = None,
    hints: Hints = Hints(),  # noqa: B008  (frozen)
) -> Scene:
    """Reads posed photos and builds their scene, see `assemble_scene`.

    Args:
        source: what the user named, for messages.
        name: of the scene.
        shots: in the order of the format.
        reading: see there.
        split: None holds out every `reading.holdout`-th.
        hints: what else the file says.

    Raises:
        InputError: nothing to train on or to hold out, or photos that cannot be read.
    """
    if split is None:
        split = split_shots(source, len(shots), reading.holdout)
    checks.check_split_size(source, "train split", len(split.train))
    checks.check_split_size(source, "val split", len(split.val))
    # Part after part, so that none of them needs a copy of its pixels.
    parts = (split.train, split.val, split.test)
    shots = [shots[i] for part in parts for i in part]
    ends = np.cumsum([0, *map(len, parts)]).tolist()
    train, val, test = (list(range(*pair)) for pair in itertools.pairwise(ends))
    poses = np.stack([shot.c2w for shot in shots])
    views = read_shots(source, shots, reading)
    check_visible(source, views)

    def take(part: list[int]) -> PosedViews:
        return PosedViews(views[torch.tensor(part, dtype=torch.long)], poses[part])

    known = select_known(views, val, shots)
    return assemble_scene(source, name, take(train), take(known), take(test) if test else None, reading, hints)


def assemble_scene(
    source: Path,
    name: str,
    train: PosedViews,
    val: PosedViews,
    test: PosedViews | None,
    reading: Reading,
    hints: Hints = Hints(),  # noqa: B008  (frozen)
) -> Scene:
    """Places read photos in one frame and decides what kind of scene they show, the same for every format.

    The world is moved to the region that the training photos show (see `find_region`), turned so that z points up (see
    `cameras.held`), and scaled so that this region is the cube [-1, 1]^3, the box of an unbounded scene; `to_source` leads
    back. A bounded scene with `hints.keep_frame` stays where it is instead.
    """
    check_visible(source, train.views)
    kind = decide_kind(train.views, reading.bounded, reading.masked, hints.alpha_background)
    if hints.bounds is not None and reading.bounded == "auto":
        kind = replace(kind, bounded=not hints.bounds.unbounded, reason="the file states a box")
    if hints.background is not None:
        kind = replace(kind, background=hints.background)
    poses = viewing_poses(train.views.cameras, train.c2w)
    points = None if hints.points is None else torch.from_numpy(hints.points)
    region = find_region(poses, points, lambda: match_points(train.views, train.c2w))
    if not checks.NEAREST <= region.unit <= checks.FARTHEST:
        expected = f"a distance of {checks.NEAREST:g} to {checks.FARTHEST:g}"
        found = f"cameras {region.unit:.3g} from what they look at"
        raise InputError(source, "poses", found, expected, "take another unit")
    text = "%s: taken as %s, since %s (dataset.bounded overrides); %s cameras"
    log.info(text, name, "bounded" if kind.bounded else "unbounded", kind.reason, region.layout)
    if not region.known and not kind.bounded:
        log.warning("%s: %s", source, region.doubt)
    splits = {"train": train, "val": val} | ({} if test is None else {"test": test})
    # Single precision tells pixels apart in the file's frame unless its origin is far away, as of georeferenced files.
    rounding = checks.STEP * float(np.abs(train.c2w[:, :3, 3]).max())
    is_precise = rounding <= region.unit / float(train.views.cameras.K[:, 0, 0].median())
    if hints.bounds is not None or (hints.keep_frame and kind.bounded and is_precise):
        to_source = torch.eye(4, dtype=torch.float64)
    else:
        _, to_source = normalize_poses(torch.from_numpy(train.c2w), torch.arange(len(train.c2w)), region)
    from_source = torch.linalg.inv(to_source)

    def move(cameras: Cameras, c2w: Float[np.ndarray, "V 4 4"]) -> Cameras:
        return replace(cameras, c2w=in_other_frame(torch.from_numpy(c2w), from_source).float())

    def place(posed: PosedViews) -> Views:
        views = apply_alpha(posed.views, kind.alpha)
        return replace(views, cameras=move(views.cameras, posed.c2w))

    placed = {key: place(posed) for key, posed in splits.items()}
    views = placed["train"]
    scale = float(torch.linalg.det(from_source[:3, :3])) ** (1 / 3)
    near, far = (None if x is None else x * scale for x in (hints.near, hints.far))
    if hints.bounds is not None:
        bounds = replace(hints.bounds, near=near, far=far)
    elif kind.bounded:
        bounds = estimate_bounds(views, kind.background, near, far)
    else:
        bounds = replace(unbounded_box(views, from_source, hints, region), far=far)
        bounds = bounds if near is None else replace(bounds, near=near)
    centre = transform(from_source, region.centre.double()).float()
    path = None if hints.path is None else move(hints.path, hints.path.c2w.double().numpy())
    return Scene(
        name=name.lower(),
        source=str(source),
        train=views,
        val=placed["val"],
        test=placed.get("test"),
        orbit=orbit_like(views.cameras, layout=region.layout, centre=centre) if path is None else path,
        bounds=bounds,
        background=kind.background,
        to_source=to_source if hints.to_source is None else torch.from_numpy(hints.to_source) @ to_source,
        kind=f"{kind.reason}; {region.layout} cameras",
        points=None if region.points is None else transform(from_source, region.points).float(),
    )


def unbounded_box(views: Views, from_source: Float[Tensor, "4 4"], hints: Hints, region: Region) -> Bounds:
    """The cube [-1, 1]^3, and where sampling starts: before the nearest content that is known, or what cameras look at."""
    known = [] if hints.nearest is None else [hints.nearest * float(torch.linalg.det(from_source[:3, :3])) ** (1 / 3)]
    if hints.points is not None and len(hints.points):
        known.append(nearest_point(transform(from_source, torch.from_numpy(hints.points)).float(), views))
    starts = [CLEAR * distance for distance in known]
    if region.has_subject:
        starts.append(NEAR * nearest_camera(views))
    return Bounds(torch.tensor([[-1.0] * 3, [1.0] * 3]), unbounded=True, near=min(starts, default=None))


def viewing_poses(cameras: Cameras, c2w: Float[np.ndarray, "V 4 4"]) -> Float[Tensor, "W 4 4"]:
    """Poses whose axes say where cameras look: of a photo of all directions, four around its vertical axis."""
    poses = torch.from_numpy(c2w)
    if not has_panoramas(cameras):
        return poses
    quarter = torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]], dtype=torch.float64)
    return torch.cat([poses @ torch.linalg.matrix_power(quarter, turns) for turns in range(4)])


def nearest_camera(views: Views) -> float:
    """Distance of the nearest camera to the region's centre, at most the usual one, in the scene's unit."""
    return min(1.0, float(views.cameras.centres.norm(dim=1).min()))


def nearest_point(points: Float[Tensor, "P 3"], views: Views) -> float:
    """Distance of the nearest points to the camera that sees them, stray ones aside; infinite where none sees any."""
    some = points[:: -(-len(points) // POINTS)]
    found = [math.inf]
    for view in range(len(views)):
        distance = (some - views.cameras.centres[view]).norm(dim=1)[views.cameras.project(some, view)[2]]
        if len(distance):
            found.append(float(distance.quantile(STRAY)))
    return min(found)


def select_known(views: Views, val: list[int], shots: Sequence[Shot]) -> list[int]:
    """Held-out photos of which something is known; a line names the others."""
    if views.known is None:
        return val
    kept = [view for view in val if bool(views.mask_of(view).any())]
    if lost := [shots[view].name for view in val if view not in kept]:
        log.warning("%d held-out photos are masked entirely, %s first: left out", len(lost), lost[0])
    checks.check_split_size(shots[0].photo.parent, "val split", len(kept))
    return kept


def normalize_poses(
    c2w: Float[Tensor, "V 4 4"], train: Int[Tensor, "T"], region: Region
) -> tuple[Float[Tensor, "V 4 4"], Float[Tensor, "4 4"]]:
    """Poses in a frame centred on a region, in its unit, with what is up in the training photos along z; and the similarity
    back."""
    turn = turn_upright(held(c2w[train])[0])
    moved = c2w.clone()
    moved[:, :3, :3] = turn @ c2w[:, :3, :3]
    moved[:, :3, 3] = (c2w[:, :3, 3] - region.centre) @ turn.mT / region.unit
    to_source = torch.eye(4, dtype=torch.float64)
    to_source[:3, :3] = region.unit * turn.mT
    to_source[:3, 3] = region.centre
    return moved, to_source
