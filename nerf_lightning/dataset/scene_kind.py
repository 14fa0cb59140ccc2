"""Decides, from the photos alone, whether a scene is bounded: an object without surroundings, or a place with a background."""

from dataclasses import dataclass, replace

import numpy as np

from nerf_lightning.dataset.scene_bounds import MAX_HULL_VIEWS, extract_border, find_border_colour
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError

MIN_TRANSPARENT_FRACTION = 0.2
"""Least share of a photo that is transparent around a subject that is cut out. Less is a margin, as undistorting leaves."""
MIN_TRANSPARENT_BORDER_FRACTION = 0.5
"""Least share of a photo's border that is transparent around such a subject."""
MAX_HIDDEN_ALPHA = 5
"""Alpha, in 1/255, up to which a pixel shows nothing."""
MIN_OPAQUE_ALPHA = 250
"""Alpha, in 1/255, from which a pixel shows what was photographed and nothing else."""
MIN_CUTOUT_FRACTION = 0.5
"""Least share of photos that must be cut out for the scene to be an object."""


@dataclass(frozen=True)
class SceneKind:
    """What the photos show."""

    bounded: bool
    """Whether nothing is to be seen outside a box around the subject."""
    background: tuple[float, float, float]
    """Colour behind the subject, sRGB in [0, 1]."""
    reason: str
    """Why, in a few words for a line and for results.json."""
    is_cutout: bool = False
    """Whether the photos' alpha cuts the subject out; else transparent pixels are unknown."""


def classify_scene(views: Views, bounded: str, masked: str, alpha_background: tuple[float, float, float]) -> SceneKind:
    """Decides what photos show; the same for every file format.

    Alpha that leaves out most of the photos' borders cuts a subject out; one colour along the borders of photos without
    alpha does too. All else is a place with a background, and alpha there is a mask.

    Args:
        views: training photos.
        bounded: `auto`, or `true` or `false` where the user knows.
        masked: `background` where the user knows that alpha cuts out, see `PhotoLoadOptions`.
        alpha_background: what photos with alpha are composited on, the format's convention.
    """
    is_cutout = views.channels == 4 and (masked == "background" or has_cutout_alpha(views))
    if is_cutout:
        found = SceneKind(True, alpha_background, "alpha cuts the subject out", is_cutout)
    elif (colour := find_border_colour(views)) is not None:
        shown = ", ".join(f"{part:.2f}" for part in colour)
        found = SceneKind(True, colour, f"the photos' borders have one colour ({shown})")
    else:
        found = SceneKind(False, (0.0, 0.0, 0.0), "the photos show a background up to their borders")
    if bounded != "auto" and found.bounded != (bounded == "true"):
        found = replace(found, bounded=not found.bounded, reason=f"dataset.bounded={bounded}")
    return found


def has_cutout_alpha(views: Views) -> bool:
    """Whether alpha leaves out what surrounds a subject, in most of the photos."""
    cut = []
    for view in range(len(some := views.subsample(MAX_HULL_VIEWS))):
        hidden = some.image(view)[..., 3].numpy() <= MAX_HIDDEN_ALPHA
        cut.append(
            hidden.mean() >= MIN_TRANSPARENT_FRACTION
            and extract_border(hidden).mean() >= MIN_TRANSPARENT_BORDER_FRACTION
        )
    return bool(np.mean(cut) >= MIN_CUTOUT_FRACTION)


def apply_alpha(views: Views, is_cutout: bool) -> Views:
    """Photos with the alpha that cuts out, else without it: nothing is known of pixels that were transparent."""
    if views.channels == 3 or is_cutout:
        return views
    known = views.pixels[:, 3] >= MIN_OPAQUE_ALPHA
    known = known if views.valid_mask is None else known & views.valid_mask
    return replace(views, pixels=views.pixels[:, :3].contiguous(), valid_mask=None if bool(known.all()) else known)


def check_visible_pixels(source: object, views: Views) -> None:
    """Refuses photos of which nothing is visible or known.

    Raises:
        InputError: alpha is 0 everywhere, or masks leave out every pixel.
    """
    is_transparent = views.channels == 4 and not bool(views.pixels[:, 3].any())
    if is_transparent or (views.valid_mask is not None and not bool(views.valid_mask.any())):
        found = "alpha or masks leave out all of the training photos"
        raise InputError(source, "", found, hint="dataset.invert_masks=true?")
