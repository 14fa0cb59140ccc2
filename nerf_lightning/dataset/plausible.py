"""Data that can be read but cannot be learned from: wrong poses, wrong background, a box that is too small."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Layout
from nerf_lightning.cameras.layout import find_convergence
from nerf_lightning.dataset.conventions import Doubt, judge_cameras
from nerf_lightning.dataset.extent import (
    MAX_VIEWS,
    border_colour,
    sightings,
    silhouettes,
    visible_cube,
    visual_hull,
)
from nerf_lightning.dataset.kind import check_visible
from nerf_lightning.dataset.region import find_region
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError

SAME_PLACE, SAME_WAY = 1e-6, 1e-6
"""Cameras nearer than these (of the scene's size, and entry by entry of the rotation) stand in one pose."""
ALIKE = 1.0
"""Mean difference between photos, in 1/255, up to which they show the same."""
OTHER_COLOUR = 8 / 255
"""A border that differs from the background by more than this, in any channel, shows something else."""
HULL = 40
"""Voxels along each side of the grid that holds the visual hull."""
FITS, FITS_BADLY, FITS_WELL = 0.5, 0.7, 0.975
"""Shares of the silhouettes that the visual hull must cover: below the first the data is hopeless, below the second poses are
certainly wrong, below the third it is doubtful.

Exact poses of the built-in scene and of Lego explain all; ones off by 2 degrees and 3 % of their distance 82 to 89 %, by 5
degrees and 5 % 47 to 57 %; three of others among a hundred 98 %. Shuffled ones may explain 86 %, of content that is much alike
from all sides.
"""
IN_BOX = 0.9
"""Coverage inside the box below which content lies outside it, provided the hull without the box fits well."""
AROUND, OFF_CENTRE = 0.35, 0.5
"""Mean of the directions to cameras up to which they stand all around, and the largest offset of the box, as a share of their
distance."""
FAR_OFF = 8.0
"""Largest distance of cameras from the box's centre, in its half-sizes, in an unbounded scene."""
BACKWARD = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
"""Turns a camera around."""
CUT = 0.02
"""Mean share of a ray's way through the box that near or far may cut off."""


def check_scene(scene: Scene, corrected: bool = False) -> list[Doubt]:
    """Checks a scene before training and returns what to warn of.

    Args:
        scene: to train on.
        corrected: whether training corrects poses: outlines that fit no body are worth a try then.

    Raises:
        InputError: no method can learn anything from the data.
    """
    doubts = []
    for check in (empty, cameras, border, misfits, repeats, overlap, cut_short, off_centre):
        for doubt in check(scene):
            if doubt.hopeless and not (corrected and doubt.inexact):
                expected = "photos and poses that fit each other"
                raise InputError(scene.source, "", doubt.text, expected, doubt.todo)
            doubts.append(doubt)
    return doubts


def empty(scene: Scene) -> Iterator[Doubt]:
    """Photos that show nothing, or nothing to learn a third dimension from."""
    views, todo = scene.train, "take several photos of it from different places"
    if len(views) == 1:
        yield Doubt("one photo to train on", hopeless=True, todo=todo)
    check_visible(scene.source, views)
    if (views.pixels == views.pixels[:1]).all():
        yield Doubt("training photos of one colour: nothing is visible", hopeless=True, todo="export them again")
    elif len(views) > 1 and views.cameras.one_size and are_alike(views):
        yield Doubt("training photos that are all alike", hopeless=True, todo=todo)


def are_alike(views: Views) -> bool:
    """Whether photos of one size differ by no more than noise."""
    images = views.images
    return all(float((image.float() - images[0].float()).abs().mean()) < ALIKE for image in images[1:])


def cameras(scene: Scene) -> Iterator[Doubt]:
    """Cameras that do not fit the photos, by the matches between these; without matches, ones that look away."""
    doubts, fits = judge_cameras(scene)
    yield from doubts
    c2w = scene.train.cameras.c2w
    if (
        not (doubts or fits)
        and len(c2w) > 2
        and find_convergence(c2w) is None
        and find_convergence(c2w @ BACKWARD) is not None
    ):
        yield Doubt("cameras with their backs to the point where their axes meet")


def border(scene: Scene) -> Iterator[Doubt]:
    """Photos whose borders have one colour, while the background is said to have another."""
    if scene.bounds.unbounded or (found := border_colour(scene.train)) is None:
        return
    if max(abs(is_ - said) for is_, said in zip(found, scene.background, strict=True)) > OTHER_COLOUR:
        seen, said = ([round(part, 2) for part in colour] for colour in (found, scene.background))
        yield Doubt(f"borders of the colour {seen}, while the background is said to be {said}", hopeless=True)


def misfits(scene: Scene) -> Iterator[Doubt]:
    """Silhouettes that no single object can have: shuffled or rotated poses. (Those of a ball fit any pose.)"""
    views = scene.train.spread(MAX_VIEWS)
    masks = silhouettes(views, scene.background)
    if (
        masks is None
        or len(views) < 3
        or scene.bounds.unbounded
        or not any(map(np.any, masks))
        or np.mean([mask.mean() for mask in masks]) > 0.9
    ):
        return
    explained = hull_coverage(masks, views.cameras, scene.bounds)
    if explained >= FITS_WELL:
        return
    everything = Bounds(torch.from_numpy(visible_cube(views.cameras)).float())
    if explained < IN_BOX and hull_coverage(masks, views.cameras, everything) >= FITS_WELL:
        text = f"content beyond the box: the box explains {explained:.0%} of what the photos show"
        yield Doubt(text, hopeless=explained < FITS)
    else:
        text = (
            f"outlines that no body has: the photos together can explain {explained:.0%} of what each shows."
            " The poses may belong to other photos, be turned, or be inexact"
        )
        yield Doubt(text, hopeless=explained < FITS, inexact=True, far_off=explained < FITS_BADLY)


def off_centre(scene: Scene) -> Iterator[Doubt]:
    """A stated box, which holds the detail, beside what cameras all around look at, or far too small for it."""
    bounds, cameras = scene.bounds, scene.train.cameras
    region = find_region(cameras.c2w)
    off, size = float((region.centre - bounds.centre)[:2].norm()), bounds.longest
    toward = torch.nn.functional.normalize(cameras.centres - region.centre.float(), dim=1)
    around = region.layout == Layout.INWARD and float(toward[:, :2].mean(0).norm()) < AROUND
    if around and off > OFF_CENTRE * region.unit:
        yield Doubt(
            f"cameras stand around a place {off:.2g} beside the box's centre, at a distance of {region.unit:.2g}: the box"
            " misses what they look at"
        )
    elif bounds.unbounded and float((cameras.centres - bounds.centre).norm(dim=1).median()) > FAR_OFF * size:
        yield Doubt(f"cameras stand more than {FAR_OFF:g} times the box's half-size of {size:.2g} off its centre")


def hull_coverage(
    masks: Sequence[Bool[np.ndarray, "_ _"]], cameras: Cameras, bounds: Bounds, least: float = 1
) -> float:
    """Share of the silhouettes that their visual hull within the bounds covers, in [0, 1]; `least` views must see its parts."""
    seen = list(sightings(bounds.aabb.double().numpy(), HULL, cameras))
    hull = visual_hull(masks, seen, least)
    covered = []
    for mask, sighting in zip(masks, seen, strict=True):
        shown = np.zeros(mask.shape, np.uint8)
        kept = hull & sighting.inside
        shown[sighting.row[kept], sighting.column[kept]] = 1
        if mask.any():
            covered.append(float(sighting.grown(shown)[mask].mean()))
    return float(np.mean(covered)) if covered else 1.0


def repeats(scene: Scene) -> Iterator[Doubt]:
    """Several photos in one pose."""
    c2w = scene.train.cameras.c2w
    first = _first_alike(c2w, c2w, scene)
    doubles = int((first != torch.arange(len(c2w))).sum())
    if doubles:
        yield Doubt(f"{doubles} of {len(c2w)} training photos have the pose of another one")


def overlap(scene: Scene) -> Iterator[Doubt]:
    """Held-out views that are trained on as well: their PSNR says nothing about unseen views."""
    first = _first_alike(scene.val.cameras.c2w, scene.train.cameras.c2w, scene)
    found = (first >= 0).nonzero()[:, 0].tolist()
    same = [view for view in found if torch.equal(scene.val.image(view), scene.train.image(int(first[view])))]
    if same:
        yield Doubt(
            f"{len(same)} of {len(scene.val)} held-out photos are trained on as well: their PSNR says nothing of unseen views"
        )


def _first_alike(some: Float[Tensor, "A 4 4"], others: Float[Tensor, "B 4 4"], scene: Scene) -> Tensor:
    """For each pose the first of the others that is the same, or -1."""
    size = float(scene.train.cameras.c2w[:, :3, 3].abs().max()) + 1e-12
    place = (some[:, None, :3, 3] - others[None, :, :3, 3]).abs().amax(-1) <= SAME_PLACE * size
    way = (some[:, None, :3, :3] - others[None, :, :3, :3]).abs().amax((-1, -2)) <= SAME_WAY
    alike = place & way
    return torch.where(alike.any(1), alike.int().argmax(1), -1)


def cut_short(scene: Scene) -> Iterator[Doubt]:
    """near and far that leave out parts of the box."""
    bounds = scene.bounds
    if bounds.unbounded or (bounds.near is None and bounds.far is None):
        return
    whole = Bounds(bounds.aabb)
    views = [scene.train.cameras.view_rays(view) for view in range(min(len(scene.train), 4))]
    near, far = (torch.cat(ends) for ends in zip(*map(whole.near_far, views), strict=True))
    meets = far > near
    if not meets.any():
        return
    near, far = near[meets], far[meets]
    length = far - near
    for name, value in (("near", bounds.near), ("far", bounds.far)):
        if value is None:
            continue
        cut = value - near if name == "near" else far - value
        share = float((cut.clamp_min(0).minimum(length) / length).mean())
        if share > CUT:
            yield Doubt(
                f"{name}={value:g} cuts {share:.0%} of the box off (its rays run from {float(near.median()):.3g} to"
                f" {float(far.median()):.3g}); leave it out, and the box decides",
                hopeless=share > 0.99,
            )
