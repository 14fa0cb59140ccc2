"""The check report: facts of a scene, warnings, consistency checks, issues of photos, and the HTML page."""

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from logging.handlers import BufferingHandler
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerf_lightning.cameras import Projection
from nerf_lightning.check.photo_quality import PhotoQuality, find_issues, measure_photos
from nerf_lightning.dataset import Scene
from nerf_lightning.dataset.scene_checks import check_scene
from nerf_lightning.drawing.camera_map import plot_camera_map
from nerf_lightning.drawing.panels import encode_data_url
from nerf_lightning.drawing.style import rasterize_figure
from nerf_lightning.errors import InputError
from nerf_lightning.utils.html import render_page

FOLDER = Path(__file__).parent
MAX_WARNINGS = 10_000


@contextmanager
def record_warnings() -> Iterator[list[logging.LogRecord]]:
    """Records the package's warnings within a block, such as excluded photos."""
    handler, log = BufferingHandler(MAX_WARNINGS), logging.getLogger("nerf_lightning")
    handler.setLevel(logging.WARNING)
    log.addHandler(handler)
    try:
        yield handler.buffer
    finally:
        log.removeHandler(handler)


def check_before_training(scene: Scene) -> list[str]:
    """Runs the checks before training and returns their messages, errors included."""
    try:
        return [finding.text for finding in check_scene(scene)]
    except InputError as error:
        return [str(error)]


def assess_photos(scene: Scene) -> tuple[list[PhotoQuality], list[tuple[int, Float[np.ndarray, "4 4"]]]]:
    """Measures all photos and finds their issues, in the order of their names; also the number and pose of each."""
    photos = [*measure_photos(scene.train, "train"), *measure_photos(scene.val, "held out")]
    poses = [*scene.train.cameras.c2w.double().numpy(), *scene.val.cameras.c2w.double().numpy()]
    posed = sorted(zip(photos, poses, strict=True), key=lambda pair: pair[0].name)
    for number, (photo, _) in enumerate(posed, 1):
        photo.number = number
    photos.sort(key=lambda photo: photo.number)
    find_issues(photos, not scene.bounds.unbounded)
    return photos, [(photo.number, pose) for photo, pose in posed]


def describe_scene(scene: Scene) -> dict[str, str]:
    """Facts of a scene, by name."""
    sizes = Counter(map(tuple, scene.train.cameras.sizes.tolist() + scene.val.cameras.sizes.tolist()))
    cameras, bounds = scene.train.cameras, scene.bounds
    lens = "pinhole" if cameras.lenses is None else "distorted; rays follow the lens"
    for projection in (Projection.FISHEYE, Projection.EQUIRECTANGULAR):
        if cameras.lenses is not None and bool((cameras.lenses.projection == projection).any()):
            lens = f"{projection.name.lower()}; rays follow the lens"
    low, high = (", ".join(f"{value:.3g}" for value in corner.tolist()) for corner in bounds.aabb)
    facts = {
        "source": scene.source,
        "photos": f"{len(scene.train)} to train on, {len(scene.val)} held out",
        "sizes": ", ".join(f"{count} of {width} x {height}" for (width, height), count in sizes.items()),
        "lens": lens,
        "focal length": f"{float(cameras.K[:, 0, 0].median()):.1f} pixels (median)",
        "box": f"from ({low}) to ({high})" + (", with surroundings" if bounds.unbounded else ", with nothing outside"),
    }
    if scene.train.valid_mask is not None:
        facts["masked"] = f"{1 - float(scene.train.valid_mask.float().mean()):.0%} of the pixels are unknown"
    elif scene.train.channels == 4:
        facts["masked"] = "photos have alpha: what is transparent is empty"
    return facts


def render_check_page(
    scene: Scene, remarks: list[str], photos: Sequence[PhotoQuality], poses: list[tuple[int, Float[np.ndarray, "4 4"]]]
) -> str:
    """Renders the page's HTML, with the remarks first and photos by their number of issues."""
    worst_first = sorted(photos, key=lambda photo: (-len(photo.issues), photo.number))
    return render_page(
        FOLDER / "check.html",
        [FOLDER / "check.css"],
        title=scene.name,
        facts=describe_scene(scene),
        remarks=remarks,
        photos=[(photo, encode_data_url(photo.preview, "jpeg")) for photo in worst_first],
        bad=sum(bool(photo.issues) for photo in photos),
        map=encode_data_url(rasterize_figure(plot_camera_map(poses, scene, {})), "png"),
    )
