"""Data that can be read but cannot be learned from: wrong poses, wrong background, a box that is too small."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, CameraLayout
from nerf_lightning.cameras.camera_layout import find_convergence
from nerf_lightning.dataset.matching.pose_checks import SceneIssue, compare_with_matches
from nerf_lightning.dataset.region import find_region
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.scene_bounds import (
    MAX_HULL_VIEWS,
    estimate_visible_cube,
    extract_silhouettes,
    find_border_colour,
    measure_hull_coverage,
)
from nerf_lightning.errors import InputError

POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-6, 1e-6
"""Cameras nearer than these (of the scene's size, and entry by entry of the rotation) stand in one pose."""
MAX_DUPLICATE_DIFFERENCE = 1.0
"""Mean difference between photos, in 1/255, up to which they show the same."""
BACKGROUND_TOLERANCE = 8 / 255
"""A border that differs from the background by more than this, in any channel, shows something else."""
MIN_COVERAGE, SUSPECT_COVERAGE, GOOD_COVERAGE = 0.5, 0.7, 0.975
"""Shares of the silhouettes that the visual hull must cover: below the first the data is hopeless, below the second poses are
certainly wrong, below the third it is doubtful.

Exact poses of the built-in scene and of Lego explain all; ones off by 2 degrees and 3 % of their distance 82 to 89 %, by 5
degrees and 5 % 47 to 57 %; three of others among a hundred 98 %. Shuffled ones may explain 86 %, of content that is much alike
from all sides.
"""
MAX_CONTENT_FRACTION = 0.9
"""Mean share of the photos up to which silhouettes say anything."""
MIN_BOX_COVERAGE = 0.9
"""Coverage inside the box below which content lies outside it, provided the hull without the box fits well."""
AROUND, OFF_CENTRE = 0.35, 0.5
"""Mean of the directions to cameras up to which they stand all around, and the largest offset of the box, as a share of their
distance."""
FAR_OFF = 8.0
"""Largest distance of cameras from the box's centre, in its half-sizes, in an unbounded scene."""
BACKWARD = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
"""Turns a camera around."""
MAX_CLIPPED_FRACTION = 0.02
"""Mean share of a ray's way through the box that near or far may cut off."""


def check_scene(scene: Scene, refines_poses: bool = False) -> list[SceneIssue]:
    """Checks a scene before training and returns what to warn of.

    Args:
        scene: to train on.
        corrected: whether training corrects poses: outlines that fit no body are worth a try then.

    Raises:
        InputError: no method can learn anything from the data.
    """
    doubts = []
    for check in (check_content, check_cameras, check_background, check_silhouettes, check_duplicates, check_bounds):
        for doubt in check(scene):
            if doubt.is_fatal and not (refines_poses and doubt.is_refinable):
                raise InputError(scene.source, "", doubt.text, hint=doubt.hint)
            doubts.append(doubt)
    return doubts


def check_content(scene: Scene) -> Iterator[SceneIssue]:
    """Photos that show nothing, or nothing to learn a third dimension from."""
    views, hint = scene.train, "take several photos of it from different places"
    if len(views) == 1:
        yield SceneIssue("one photo to train on", is_fatal=True, hint=hint)
    elif len(views.cameras.sizes.unique(dim=0)) == 1:
        images = views.images
        if all(
            float((image.float() - images[0].float()).abs().mean()) < MAX_DUPLICATE_DIFFERENCE for image in images[1:]
        ):
            yield SceneIssue("training photos that are all alike", is_fatal=True, hint=hint)


def check_cameras(scene: Scene) -> Iterator[SceneIssue]:
    """Cameras that do not fit the photos, by the matches between these; without matches, ones that look away."""
    issues, has_evidence = compare_with_matches(scene)
    yield from issues
    c2w = scene.train.cameras.c2w
    if issues or has_evidence or len(c2w) <= 2 or find_convergence(c2w) is not None:
        return
    if find_convergence(c2w @ BACKWARD) is not None:
        yield SceneIssue("cameras with their backs to the point where their axes meet")


def check_background(scene: Scene) -> Iterator[SceneIssue]:
    """Photos whose borders have one colour, while the background is said to have another."""
    if scene.bounds.unbounded or (found := find_border_colour(scene.train)) is None:
        return
    if max(abs(is_ - said) for is_, said in zip(found, scene.background, strict=True)) > BACKGROUND_TOLERANCE:
        seen, said = ([round(part, 2) for part in colour] for colour in (found, scene.background))
        yield SceneIssue(f"borders of the colour {seen}, while the background is said to be {said}", is_fatal=True)


def check_silhouettes(scene: Scene) -> Iterator[SceneIssue]:
    """Silhouettes that no single object can have: shuffled or rotated poses. (Those of a ball fit any pose.)"""
    views = scene.train.subsample(MAX_HULL_VIEWS)
    masks = extract_silhouettes(views, scene.background)
    if masks is None or len(views) < 3 or scene.bounds.unbounded:
        return
    share = np.mean([mask.mean() for mask in masks])
    if (
        not 0 < share <= MAX_CONTENT_FRACTION
        or (explained := measure_hull_coverage(masks, views.cameras, scene.bounds)) >= GOOD_COVERAGE
    ):
        return
    everything = Bounds(torch.from_numpy(estimate_visible_cube(views.cameras)).float())
    if explained < MIN_BOX_COVERAGE and measure_hull_coverage(masks, views.cameras, everything) >= GOOD_COVERAGE:
        text = f"content beyond the box: the box explains {explained:.0%} of what the photos show"
        yield SceneIssue(text, is_fatal=explained < MIN_COVERAGE)
    else:
        text = (
            f"outlines that no body has: the photos together can explain {explained:.0%} of what each shows."
            " The poses may belong to other photos, be turned, or be inexact"
        )
        yield SceneIssue(
            text, is_fatal=explained < MIN_COVERAGE, is_refinable=True, has_wrong_poses=explained < SUSPECT_COVERAGE
        )


def check_duplicates(scene: Scene) -> Iterator[SceneIssue]:
    """Several photos in one pose; and held-out views that are trained on, whose PSNR says nothing about unseen views."""
    c2w, val = scene.train.cameras.c2w, scene.val
    doubles = int((find_duplicate_poses(c2w, c2w) != torch.arange(len(c2w))).sum())
    if doubles:
        yield SceneIssue(f"{doubles} of {len(c2w)} training photos have the pose of another one")
    first = find_duplicate_poses(val.cameras.c2w, c2w).tolist()
    same = sum(i >= 0 and torch.equal(val.image(view), scene.train.image(i)) for view, i in enumerate(first))
    if same:
        text = f"{same} of {len(val)} held-out photos are trained on as well: their PSNR says nothing of unseen views"
        yield SceneIssue(text)


def find_duplicate_poses(some: Float[Tensor, "A 4 4"], others: Float[Tensor, "B 4 4"]) -> Tensor:
    """For each pose the first of the others that is the same, or -1."""
    size = float(others[:, :3, 3].abs().max()) + 1e-12
    tolerance = torch.full((4, 4), ROTATION_TOLERANCE)
    tolerance[:3, 3] = POSITION_TOLERANCE * size
    alike = ((some[:, None] - others).abs() <= tolerance).all(-1).all(-1)
    return torch.where(alike.any(1), alike.int().argmax(1), -1)


def check_bounds(scene: Scene) -> Iterator[SceneIssue]:
    """A box beside what cameras all around look at, or far too small for it; near and far that leave out parts of the box."""
    bounds, cameras = scene.bounds, scene.train.cameras
    if not bounds.unbounded and (bounds.near, bounds.far) != (None, None):
        yield from check_clipping(scene)
    region = find_region(cameras.c2w)
    off, size = float((region.centre - bounds.centre)[:2].norm()), bounds.max_half_size
    toward = torch.nn.functional.normalize(cameras.centres - region.centre.float(), dim=1)
    around = region.layout == CameraLayout.INWARD and float(toward[:, :2].mean(0).norm()) < AROUND
    if around and off > OFF_CENTRE * region.unit:
        yield SceneIssue(
            f"cameras stand around a place {off:.2g} beside the box's centre, at a distance of {region.unit:.2g}: the box"
            " misses what they look at"
        )
    elif bounds.unbounded and float((cameras.centres - bounds.centre).norm(dim=1).median()) > FAR_OFF * size:
        yield SceneIssue(f"cameras stand more than {FAR_OFF:g} times the box's half-size of {size:.2g} off its centre")


def check_clipping(scene: Scene) -> Iterator[SceneIssue]:
    """near and far that leave out parts of the box, by the rays of a few photos."""
    bounds, cameras = scene.bounds, scene.train.cameras
    rays = [Bounds(bounds.aabb).near_far(cameras.generate_view_rays(view)) for view in range(min(len(cameras), 4))]
    near, far = map(torch.cat, zip(*rays, strict=True))
    meets = far > near
    near, far = near[meets], far[meets]
    for name, value in (("near", bounds.near), ("far", bounds.far)):
        if value is None or not len(near):
            continue
        cut = (value - near if name == "near" else far - value).clamp_min(0)
        share = float((cut.minimum(far - near) / (far - near)).mean())
        if share > MAX_CLIPPED_FRACTION:
            yield SceneIssue(
                f"{name}={value:g} cuts {share:.0%} of the box off (its rays run from {float(near.median()):.3g} to"
                f" {float(far.median()):.3g}); leave it out, and the box decides",
                is_fatal=share > 0.99,
            )
