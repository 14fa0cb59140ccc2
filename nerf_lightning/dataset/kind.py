"""Decides, from the photos alone, whether a scene is bounded: an object without surroundings, or a place with a background."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.dataset.extent import MAX_VIEWS, border_colour, take_border
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError

MIN_TRANSPARENT_SHARE = 0.2
"""Least share of a photo that is transparent around a subject that is cut out. Less is a margin, as undistorting leaves."""
MIN_TRANSPARENT_BORDER = 0.5
"""Least share of a photo's border that is transparent around such a subject."""
MIN_ALPHA_VISIBLE = 0.02
OPAQUE = 250
"""Alpha, in 1/255, from which a pixel shows what was photographed and nothing else."""
MIN_CUT_OUT_PHOTOS = 0.5
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
    alpha: str = "none"
    """What the photos' alpha means: `cut_out`, `mask` (transparent pixels are unknown), or `none`."""


def decide_kind(views: Views, bounded: str, masked: str, alpha_background: tuple[float, float, float]) -> SceneKind:
    """Decides what photos show; the same for every file format.

    Alpha that leaves out most of the photos' borders cuts a subject out; one colour along the borders of photos without
    alpha does too. All else is a place with a background, and alpha there is a mask.

    Args:
        views: training photos.
        bounded: `auto`, or `true` or `false` where the user knows.
        masked: `empty` where the user knows that alpha cuts out, see `PhotoLoadOptions`.
        alpha_background: what photos with alpha are composited on, the format's convention.
    """
    alpha = "cut_out" if masked == "empty" and views.channels == 4 else interpret_alpha(views)
    colour = border_colour(views) if alpha == "none" else None
    if alpha == "cut_out":
        found = SceneKind(True, alpha_background, "alpha cuts the subject out", alpha)
    elif colour is not None:
        shown = ", ".join(f"{part:.2f}" for part in colour)
        found = SceneKind(True, colour, f"the photos' borders have one colour ({shown})", alpha)
    else:
        found = SceneKind(False, (0.0, 0.0, 0.0), "the photos show a background up to their borders", alpha)
    if bounded != "auto" and found.bounded != (bounded == "true"):
        found = replace(found, bounded=not found.bounded, reason=f"dataset.bounded={bounded}")
    return found


def interpret_alpha(views: Views) -> str:
    """What alpha means: `cut_out`, `mask`, or `none` where there is none or all of it is opaque."""
    if views.channels == 3:
        return "none"
    if bool((views.pixels[:, 3] >= OPAQUE).all()):
        return "none"
    some = views.spread(MAX_VIEWS)
    alphas = [some.image(view)[..., 3].numpy() / 255 for view in range(len(some))]
    return "cut_out" if np.mean([is_cut_out(alpha) for alpha in alphas]) >= MIN_CUT_OUT_PHOTOS else "mask"


def is_cut_out(alpha: Float[np.ndarray, "H W"]) -> bool:
    """Whether a photo's alpha, in [0, 1], leaves out what surrounds a subject."""
    hidden = alpha <= MIN_ALPHA_VISIBLE
    return bool(hidden.mean() >= MIN_TRANSPARENT_SHARE and take_border(hidden).mean() >= MIN_TRANSPARENT_BORDER)


def apply_alpha(views: Views, meaning: str) -> Views:
    """Photos whose alpha is what it means: kept where it cuts out, else left out, and of a mask's pixels nothing is known."""
    if views.channels == 3 or meaning == "cut_out":
        return views
    known: Bool[Tensor, "N"] = views.pixels[:, 3] >= OPAQUE
    counted = known if views.known is None else known & views.mask
    counts_all = meaning == "none" and views.known is None
    return replace(views, pixels=views.pixels[:, :3].contiguous(), known=None if counts_all else counted)


def check_visible(source: object, views: Views) -> None:
    """Refuses photos of which nothing is visible or known.

    Raises:
        InputError: alpha is 0 everywhere, or masks leave out every pixel.
    """
    if views.channels == 4 and not bool(torch.any(views.pixels[:, 3])):
        raise InputError(source, "", "training photos whose alpha is 0 everywhere", "photos that show something")
    if views.known is not None and not views.known.any():
        raise InputError(
            source,
            "",
            "masks that leave out every pixel",
            "photos of which something is known",
            "dataset.invert_masks=true?",
        )
