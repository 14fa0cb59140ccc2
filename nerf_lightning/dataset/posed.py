"""From posed photos to a scene: one frame and one unit, split, bounds and an orbit, the same for every format."""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds, axes_meet, focus_point, held, orbit_like, transform, turn_upright
from nerf_lightning.dataset.extent import border_colour, estimate_bounds, viewing_distance
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import Reading, Shot, read_shots
from nerf_lightning.dataset.views import Views

log = logging.getLogger(__name__)

BLACK = (0.0, 0.0, 0.0)
NEAR = 0.25
"""Sampling starts at this share of the nearest camera's distance to what all look at, where they look at one thing."""
CLEAR = 0.7
"""Or at this share of the nearest known content's distance, if that is less."""
POINTS, STRAY = 4096, 0.01
"""Points that are looked at, and the share of a view's that may be wrong."""


def scene_of(
    source: Path,
    name: str,
    shots: Sequence[Shot],
    reading: Reading,
    split: tuple[list[int], list[int]] | None = None,
    nearest: float | None = None,
    points: Float[np.ndarray, "P 3"] | None = None,
) -> Scene:
    """Posed photos in some frame become a scene.

    The world is moved to what the training cameras look at, turned so that z points up (see `cameras.held`), and scaled so
    that their median distance to that place is 1; `to_source` leads back. Photos with alpha, and photos whose borders have
    one colour, give a bounded scene, all others an unbounded one around the cube [-1, 1]^3.

    Args:
        source: what the user named, for messages.
        name: of the scene.
        shots: sorted by name.
        reading: see there.
        split: indices of training and held-out photos; None holds out every `reading.holdout`-th.
        nearest: distance of the nearest content to a camera, in the file's unit, where the file tells.
        points: on surfaces, in the file's frame; they tell it too.

    Raises:
        InputError: nothing to train on or to hold out, or photos that cannot be read.
    """
    if split is None:
        everything = range(len(shots))
        split = [i for i in everything if i % reading.holdout], list(everything[:: reading.holdout])
    train, val = (torch.tensor(part, dtype=torch.long) for part in split)
    checks.split_size(source, "train split", len(train))
    checks.split_size(source, "val split", len(val))
    poses = np.stack([shot.c2w for shot in shots])
    checks.told_apart(source, poses[train.numpy()])  # a tensor of one number would be one photo, not a list of it
    c2w, to_source = framed(torch.from_numpy(poses), train)
    moved = [replace(shot, c2w=pose) for shot, pose in zip(shots, c2w.numpy(), strict=True)]
    views = read_shots(source, moved, reading)
    train_views, val_views = views[train], views[seen(views, val, shots)]
    background = BLACK
    known = [] if nearest is None else [nearest * float(torch.linalg.det(to_source[:3, :3])) ** (-1 / 3)]
    if points is not None and len(points):
        known.append(
            nearest_point(transform(torch.linalg.inv(to_source), torch.from_numpy(points).float()), train_views)
        )
    starts = [CLEAR * distance for distance in known]
    if axes_meet(train_views.cameras.c2w):
        starts.append(NEAR * nearest_camera(train_views))
    near = min(starts, default=None)
    bounds = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]), unbounded=True, near=near)
    if views.channels == 4:
        bounds = estimate_bounds(train_views, BLACK)
    elif (colour := border_colour(train_views)) is not None:
        background, bounds = colour, estimate_bounds(train_views, colour)
    return Scene(
        name=name.lower(),
        source=str(source),
        train=train_views,
        val=val_views,
        orbit=orbit_like(train_views.cameras),
        bounds=bounds,
        background=background,
        to_source=to_source,
    )


def nearest_camera(views: Views) -> float:
    """Distance of the nearest camera to what all look at, at most the usual one, in the scene's unit."""
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


def seen(views: Views, val: Tensor, shots: Sequence[Shot]) -> Tensor:
    """Held-out views of which something is known; a line names the others."""
    if views.known is None:
        return val
    counts = {view: int(views.mask_of(view).sum()) for view in val.tolist()}
    kept = [view for view, count in counts.items() if count]
    lost = [shots[view].name for view, count in counts.items() if not count]
    if lost:
        log.warning("%d held-out photos are masked entirely, %s first: left out", len(lost), lost[0])
    checks.split_size(shots[0].photo.parent, "val split", len(kept))
    return torch.tensor(kept, dtype=torch.long)


def framed(c2w: Float[Tensor, "V 4 4"], train: Int[Tensor, "T"]) -> tuple[Float[Tensor, "V 4 4"], Float[Tensor, "4 4"]]:
    """Poses in a frame centred on what the training cameras look at, z up, at a median distance of 1; and the similarity
    back."""
    centre = focus_point(c2w[train])
    scale = viewing_distance(c2w[train], centre)
    turn = turn_upright(held(c2w[train])[0])
    moved = c2w.clone()
    moved[:, :3, :3] = turn @ c2w[:, :3, :3]
    moved[:, :3, 3] = (c2w[:, :3, 3] - centre) @ turn.mT / scale
    to_source = torch.eye(4)
    to_source[:3, :3] = scale * turn.mT
    to_source[:3, 3] = centre
    return moved, to_source
