"""Classifies a scene from its photos: bounded (an isolated object) or unbounded (with a background)."""

from dataclasses import dataclass, replace

import numpy as np

from nerf_lightning.dataset.scene_bounds import MAX_HULL_VIEWS, extract_border, find_border_color
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError

MIN_TRANSPARENT_FRACTION = 0.2
"""Minimum transparent fraction of a cut-out photo. Less is a margin, as left by undistortion."""
MIN_TRANSPARENT_BORDER_FRACTION = 0.5
"""Minimum transparent fraction of a cut-out photo's border."""
MAX_HIDDEN_ALPHA = 5
"""Alpha, in 1/255, up to which a pixel is transparent."""
MIN_OPAQUE_ALPHA = 250
"""Alpha, in 1/255, from which a pixel is opaque."""
MIN_CUTOUT_FRACTION = 0.5
"""Minimum fraction of cut-out photos for a bounded scene."""


@dataclass(frozen=True)
class SceneKind:
    """Bounded or unbounded, background, and the reason."""

    bounded: bool
    """Whether a box around the subject contains everything visible."""
    background: tuple[float, float, float]
    """Color behind the subject, sRGB in [0, 1]."""
    reason: str
    """Short explanation for the log and results.json."""
    is_cutout: bool = False
    """Whether alpha cuts the subject out; else transparent pixels are ignored."""


def classify_scene(views: Views, bounded: str, masked: str, alpha_background: tuple[float, float, float]) -> SceneKind:
    """Classifies the scene of photos of any format.

    A scene is bounded if alpha removes most of the photos' borders, or if the borders of photos without alpha have one
    color. Everything else is unbounded, and its alpha is a mask.

    Args:
        views: training photos.
        bounded: `auto`, or the user's `true` or `false`.
        masked: `background` if alpha is known to cut out, see `PhotoLoadOptions`.
        alpha_background: the format's background for photos with alpha.
    """
    is_cutout = views.channels == 4 and (masked == "background" or has_cutout_alpha(views))
    if is_cutout:
        kind = SceneKind(True, alpha_background, "alpha cuts the subject out", is_cutout)
    elif (color := find_border_color(views)) is not None:
        rgb = ", ".join(f"{channel:.2f}" for channel in color)
        kind = SceneKind(True, color, f"the photos' borders have one color ({rgb})")
    else:
        kind = SceneKind(False, (0.0, 0.0, 0.0), "the photos show a background up to their borders")
    if bounded != "auto" and kind.bounded != (bounded == "true"):
        kind = replace(kind, bounded=not kind.bounded, reason=f"dataset.bounded={bounded}")
    return kind


def has_cutout_alpha(views: Views) -> bool:
    """Whether alpha removes the surroundings of a subject in most photos."""
    cutouts = []
    for view in range(len(subset := views.subsample(MAX_HULL_VIEWS))):
        hidden = subset.image(view)[..., 3].numpy() <= MAX_HIDDEN_ALPHA
        has_clear_border = extract_border(hidden).mean() >= MIN_TRANSPARENT_BORDER_FRACTION
        cutouts.append(has_clear_border and hidden.mean() >= MIN_TRANSPARENT_FRACTION)
    return bool(np.mean(cutouts) >= MIN_CUTOUT_FRACTION)


def apply_alpha(views: Views, is_cutout: bool) -> Views:
    """Keeps alpha that cuts out; else drops it and masks the transparent pixels."""
    if views.channels == 3 or is_cutout:
        return views
    valid = views.pixels[:, 3] >= MIN_OPAQUE_ALPHA
    valid = valid if views.valid_mask is None else valid & views.valid_mask
    return replace(views, pixels=views.pixels[:, :3].contiguous(), valid_mask=None if bool(valid.all()) else valid)


def check_visible_pixels(source: object, views: Views) -> None:
    """Raises InputError if alpha or masks remove every pixel."""
    is_transparent = views.channels == 4 and not bool(views.pixels[:, 3].any())
    if is_transparent or (views.valid_mask is not None and not bool(views.valid_mask.any())):
        found = "alpha or masks remove every pixel of the training photos"
        raise InputError(source, "", found, hint="dataset.invert_masks=true?")
