"""The page about a scene: one HTML file that opens without a network."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerf_lightning.check.findings import describe_scene
from nerf_lightning.check.quality import Photo
from nerf_lightning.dataset import Scene
from nerf_lightning.drawing.camera_map import camera_map
from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.drawing.panels import data_url
from nerf_lightning.utils.html import render_page

HERE = Path(__file__).parent


def check_page(
    scene: Scene, doubts: Sequence[str], photos: Sequence[Photo], poses: list[tuple[int, Float[np.ndarray, "4 4"]]]
) -> str:
    """The page's HTML, with what is wrong in words, and the photos with the most troubles first."""
    worst_first = sorted(photos, key=lambda photo: (-len(photo.troubles), photo.number))
    return render_page(
        HERE / "check.html",
        [HERE / "check.css"],
        title=scene.name,
        facts=describe_scene(scene),
        doubts=doubts,
        photos=[(photo, data_url(photo.small, "jpeg")) for photo in worst_first],
        bad=sum(bool(photo.troubles) for photo in photos),
        map=data_url(pixels_of(camera_map(poses, scene, {})), "png"),
    )
