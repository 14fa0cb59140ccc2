"""What the verb does: opens a scene, looks at its photos, and writes one page."""

import logging

import numpy as np

from nerf_lightning.cameras import Projection
from nerf_lightning.dataset import Reading, Scene, open_scene
from nerf_lightning.dataset.plausible import check_scene
from nerf_lightning.drawing.camera_map import camera_map
from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.errors import InputError
from nerf_lightning.inspect.page import inspection_page
from nerf_lightning.inspect.quality import Photo, judge, look_at
from nerf_lightning.utils.files import atomic, output_path


class Heard(logging.Handler):
    """Keeps warnings, such as those about photos that were left out."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def inspect(
    scene: str,
    output: str | None,
    resize: int | None,
    holdout: int,
    masked: str,
    invert_masks: bool,
    undistort: bool,
    bounded: str | bool = "auto",
    orientation: str = "auto",
) -> None:
    """Writes a page about a scene, and says what was found.

    Args:
        scene: see `open_scene`.
        resize, holdout, masked, invert_masks, undistort, bounded, orientation: see `Reading`.
        output: the page; None puts `inspection.html` where the command runs.

    Raises:
        InputError: no scene there, or a damaged one.
    """
    heard = Heard()
    log = logging.getLogger("nerf_lightning")
    log.addHandler(heard)
    try:
        how = Reading(resize, holdout, masked, invert_masks, undistort, str(bounded).lower(), orientation)
        found = open_scene(scene, reading=how)
        doubts = doubts_about(found)
    finally:
        log.removeHandler(heard)
    photos = [*look_at(found.train, "train", 1), *look_at(found.val, "held out", 1 + len(found.train))]
    photos.sort(key=lambda photo: (not found.train.names, photo.name))
    for number, photo in enumerate(photos, 1):
        photo.number = number
    judge(photos, not found.bounds.unbounded)
    bad = [f"{photo.name}: {trouble}" for photo in photos for trouble in photo.troubles]
    cameras = pixels_of(camera_map(poses_of(photos, found), found, {}))
    path = output_path("inspection.html" if output is None else output)
    with atomic(path) as temporary:
        temporary.write_text(
            inspection_page(found.name, facts_of(found), heard.lines + doubts + bad, photos, cameras), encoding="utf-8"
        )
    for line in doubts + bad:
        print(line)
    print(f"{found.name}: {len(photos)} photos, {len(bad)} remarks on them; {path}")


def doubts_about(scene: Scene) -> list[str]:
    """What the checks before training say, refusals too."""
    try:
        return [doubt.text for doubt in check_scene(scene)]
    except InputError as error:
        return [str(error)]


def poses_of(photos: list[Photo], scene: Scene) -> list[tuple[int, np.ndarray]]:
    """Each photo's number and pose; `photos` are sorted, those of a split in its order."""
    poses = []
    for split, views in (("train", scene.train), ("held out", scene.val)):
        of_split = [photo for photo in photos if photo.split == split]
        if views.names:
            of_split.sort(key=lambda photo: views.names.index(photo.name))
        poses += [(photo.number, c2w) for photo, c2w in zip(of_split, views.cameras.c2w.double().numpy(), strict=True)]
    return poses


def facts_of(scene: Scene) -> dict[str, str]:
    """What the scene is."""
    sizes: dict[tuple[int, ...], int] = {}
    for size in scene.train.cameras.sizes.tolist() + scene.val.cameras.sizes.tolist():
        sizes[tuple(size)] = sizes.get(tuple(size), 0) + 1
    cameras, bounds = scene.train.cameras, scene.bounds
    lens = "pinhole" if cameras.lenses is None else "distorted; rays follow the lens"
    for projection in (Projection.FISHEYE, Projection.EQUIRECTANGULAR):
        if cameras.lenses is not None and bool((cameras.lenses.projection == projection).any()):
            lens = f"{projection.name.lower()}; rays follow the lens"
    low, high = (", ".join(f"{value:.3g}" for value in corner.tolist()) for corner in bounds.aabb)
    facts = {
        "source": scene.source,
        "photos": f"{len(scene.train)} to train on, {len(scene.val)} held out",
        "sizes": ", ".join(f"{count} of {width}x{height}" for (width, height), count in sizes.items()),
        "lens": lens,
        "focal length": f"{float(cameras.K[:, 0, 0].median()):.1f} pixels (median)",
        "box": f"from ({low}) to ({high})" + (", with surroundings" if bounds.unbounded else ", with nothing outside"),
    }
    if scene.train.known is not None:
        facts["masked"] = f"{1 - len(scene.train.known) / len(scene.train.pixels):.0%} of the pixels are unknown"
    elif scene.train.channels == 4:
        facts["masked"] = "photos have alpha: what is transparent is empty"
    return facts
