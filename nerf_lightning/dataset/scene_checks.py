"""Plausibility checks of a scene before training: poses, background, silhouettes, duplicates, bounds."""

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, CameraLayout
from nerf_lightning.cameras.camera_layout import find_convergence
from nerf_lightning.dataset import scene_bounds
from nerf_lightning.dataset.matching.pose_checks import SceneIssue, compare_with_matches
from nerf_lightning.dataset.region import find_region
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.errors import InputError

POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-6, 1e-6
"""Largest differences of one pose: position relative to the scene's size, and rotation per entry."""
MAX_DUPLICATE_DIFFERENCE = 1.0
"""Mean difference, in 1/255, up to which photos are duplicates."""
BACKGROUND_TOLERANCE = 8 / 255
"""Largest difference of the border from the stated background, per channel."""
MIN_COVERAGE, SUSPECT_COVERAGE, GOOD_COVERAGE = 0.5, 0.7, 0.975
"""Silhouette coverage of the visual hull: below the first the error is fatal, below the second poses are certainly wrong, below
the third doubtful.

Exact poses of the built-in scene and Lego cover everything; errors of 2 degrees and 3 % of the distance 82 to 89 %, of 5
degrees and 5 % 47 to 57 %; three wrong poses in a hundred 98 %; shuffled poses up to 86 % of near-symmetric content.
"""
MAX_CONTENT_FRACTION = 0.9
"""Largest mean silhouette area, as a fraction of the photo, for the check."""
MIN_BOX_COVERAGE = 0.9
"""Coverage inside the box below which content lies outside it, if the hull without the box fits well."""
MAX_ASYMMETRY, MAX_BOX_OFFSET = 0.35, 0.5
"""Norm of the mean direction up to which cameras surround the center; largest box offset relative to their distance."""
MAX_DISTANCE_RATIO = 8.0
"""Largest distance of cameras from the box's center, in its half-sizes, in an unbounded scene."""
BACKWARD = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
"""Rotates a camera backward."""
MAX_CLIPPED_FRACTION = 0.02
"""Largest mean fraction of a ray segment in the box that near or far may cut off."""


def check_scene(scene: Scene, refines_poses: bool = False) -> list[SceneIssue]:
    """Checks a scene before training and returns the issues to warn about.

    Args:
        scene: to train on.
        refines_poses: whether training refines poses, so that refinable issues are not fatal.

    Raises:
        InputError: a fatal issue.
    """
    issues = []
    for check in (check_content, check_cameras, check_background, check_silhouettes, check_duplicates, check_bounds):
        for issue in check(scene):
            if issue.is_fatal and not (refines_poses and issue.is_refinable):
                raise InputError(scene.source, "", issue.text, hint=issue.hint)
            issues.append(issue)
    return issues


def check_content(scene: Scene) -> Iterator[SceneIssue]:
    """Checks for a single photo or identical photos, which have no parallax."""
    views, hint = scene.train, "take several photos of it from different places"
    if len(views) == 1:
        yield SceneIssue("one photo to train on", is_fatal=True, hint=hint)
    elif len(views.cameras.sizes.unique(dim=0)) == 1:
        first, *others = views.images
        if all(float((image.float() - first.float()).abs().mean()) < MAX_DUPLICATE_DIFFERENCE for image in others):
            yield SceneIssue("identical training photos", is_fatal=True, hint=hint)


def check_cameras(scene: Scene) -> Iterator[SceneIssue]:
    """Checks cameras against feature matches; without matches, for cameras that look away from the subject."""
    issues, has_evidence = compare_with_matches(scene)
    yield from issues
    c2w = scene.train.cameras.c2w
    if issues or has_evidence or len(c2w) <= 2 or find_convergence(c2w) is not None:
        return
    if find_convergence(c2w @ BACKWARD) is not None:
        yield SceneIssue("cameras that look away from their common focus point: is z flipped (OpenGL, not OpenCV)?")


def check_background(scene: Scene) -> Iterator[SceneIssue]:
    """Checks for a uniform border color that differs from the stated background."""
    if scene.bounds.unbounded or (border := scene_bounds.find_border_color(scene.train)) is None:
        return
    if max(abs(a - b) for a, b in zip(border, scene.background, strict=True)) > BACKGROUND_TOLERANCE:
        actual, stated = ([round(channel, 2) for channel in color] for color in (border, scene.background))
        yield SceneIssue(f"border color {actual} differs from the stated background {stated}", is_fatal=True)


def check_silhouettes(scene: Scene) -> Iterator[SceneIssue]:
    """Checks silhouettes for consistency, which detects shuffled or rotated poses (not of a ball)."""
    views = scene.train.subsample(scene_bounds.MAX_HULL_VIEWS)
    masks = scene_bounds.extract_silhouettes(views, scene.background)
    if masks is None or len(views) < 3 or scene.bounds.unbounded:
        return
    measure_coverage = partial(scene_bounds.measure_hull_coverage, masks, views.cameras)
    area = np.mean([mask.mean() for mask in masks])
    if not 0 < area <= MAX_CONTENT_FRACTION or (coverage := measure_coverage(scene.bounds)) >= GOOD_COVERAGE:
        return
    visible_cube = Bounds(torch.from_numpy(scene_bounds.estimate_visible_cube(views.cameras)).float())
    is_fatal = coverage < MIN_COVERAGE
    if coverage < MIN_BOX_COVERAGE and measure_coverage(visible_cube) >= GOOD_COVERAGE:
        yield SceneIssue(f"content outside the box, which covers {coverage:.0%} of the silhouettes", is_fatal=is_fatal)
    else:
        text = (
            f"inconsistent silhouettes: their visual hull covers {coverage:.0%} of them."
            " The poses may belong to other photos, be rotated, or be inexact"
        )
        yield SceneIssue(text, is_fatal=is_fatal, is_refinable=True, has_wrong_poses=coverage < SUSPECT_COVERAGE)


def check_duplicates(scene: Scene) -> Iterator[SceneIssue]:
    """Checks for training photos in one pose, and for held-out views that are training views too."""
    c2w, val = scene.train.cameras.c2w, scene.val
    duplicates = int((find_duplicate_poses(c2w, c2w) != torch.arange(len(c2w))).sum())
    if duplicates:
        yield SceneIssue(f"{duplicates} of {len(c2w)} training photos have the pose of another one")
    first = find_duplicate_poses(val.cameras.c2w, c2w).tolist()
    same = sum(i >= 0 and torch.equal(val.image(view), scene.train.image(i)) for view, i in enumerate(first))
    if same:
        text = f"{same} of {len(val)} held-out photos are trained on as well: their PSNR says nothing of unseen views"
        yield SceneIssue(text)


def find_duplicate_poses(poses: Float[Tensor, "A 4 4"], others: Float[Tensor, "B 4 4"]) -> Tensor:
    """Finds for each pose the index of its first duplicate among `others`, or -1."""
    size = float(others[:, :3, 3].abs().max()) + 1e-12
    tolerance = torch.full((4, 4), ROTATION_TOLERANCE)
    tolerance[:3, 3] = POSITION_TOLERANCE * size
    is_same = ((poses[:, None] - others).abs() <= tolerance).all(-1).all(-1)
    return torch.where(is_same.any(1), is_same.int().argmax(1), -1)


def check_bounds(scene: Scene) -> Iterator[SceneIssue]:
    """Checks for a box off the cameras' focus point or too small, and for near and far planes that clip it."""
    bounds, cameras = scene.bounds, scene.train.cameras
    if not bounds.unbounded and (bounds.near, bounds.far) != (None, None):
        yield from check_clipping(scene)
    region = find_region(cameras.c2w)
    offset, size = float((region.center - bounds.content_center)[:2].norm()), bounds.max_half_size
    directions = torch.nn.functional.normalize(cameras.centers - region.center.float(), dim=1)
    is_surrounded = region.layout == CameraLayout.INWARD and float(directions[:, :2].mean(0).norm()) < MAX_ASYMMETRY
    if is_surrounded and offset > MAX_BOX_OFFSET * region.unit:
        yield SceneIssue(
            f"cameras look at a point {offset:.2g} from the box center, at a distance of {region.unit:.2g}: the box"
            " misses their subject"
        )
    elif bounds.unbounded and float((cameras.centers - bounds.center).norm(dim=1).median()) > MAX_DISTANCE_RATIO * size:
        yield SceneIssue(f"cameras more than {MAX_DISTANCE_RATIO:g} half-sizes ({size:.2g}) from the center of the box")


def check_clipping(scene: Scene) -> Iterator[SceneIssue]:
    """Checks near and far for clipping of the box, by the rays of a few photos."""
    bounds, cameras = scene.bounds, scene.train.cameras
    rays = [Bounds(bounds.aabb).near_far(cameras.generate_view_rays(view)) for view in range(min(len(cameras), 4))]
    near, far = map(torch.cat, zip(*rays, strict=True))
    meets = far > near
    near, far = near[meets], far[meets]
    for name, value in (("near", bounds.near), ("far", bounds.far)):
        if value is None or not len(near):
            continue
        cut = (value - near if name == "near" else far - value).clamp_min(0)
        fraction = float((cut.minimum(far - near) / (far - near)).mean())
        if fraction > MAX_CLIPPED_FRACTION:
            yield SceneIssue(
                f"{name}={value:g} clips {fraction:.0%} of the box (its rays run from {float(near.median()):.3g} to"
                f" {float(far.median()):.3g}); omit it to use the box",
                is_fatal=fraction > 0.99,
            )
