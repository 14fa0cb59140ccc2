"""The page about a scene: one HTML file that opens without a network."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from nerf_lightning.check.quality import Photo
from nerf_lightning.drawing.panels import data_url
from nerf_lightning.utils.html import render_page

HERE = Path(__file__).parent


def check_page(
    name: str,
    facts: dict[str, str],
    doubts: Sequence[str],
    photos: Sequence[Photo],
    cameras: UInt8[np.ndarray, "H W 3"],
) -> str:
    """The page's HTML.

    Args:
        name: of the scene.
        facts: what it is, by name.
        doubts: what is wrong with it, in words.
        photos: all, with their troubles; those with the most come first.
        cameras: a map of them.
    """
    worst_first = sorted(photos, key=lambda photo: (-len(photo.troubles), photo.number))
    shown = [(photo, data_url(photo.small, "jpeg")) for photo in worst_first]
    return render_page(
        HERE / "check.html",
        [HERE / "check.css"],
        title=name,
        facts=facts,
        doubts=doubts,
        photos=shown,
        bad=sum(bool(photo.troubles) for photo in photos),
        map=data_url(cameras, "png"),
    )
