"""What is known of a scene and what is doubted: facts, warnings, checks before training, and each photo's troubles."""

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from jaxtyping import Float

from nerf_lightning.cameras import Projection
from nerf_lightning.check.quality import Photo, judge, look_at
from nerf_lightning.dataset import Scene
from nerf_lightning.dataset.plausible import check_scene
from nerf_lightning.errors import InputError


class Recorder(logging.Handler):
    """Keeps warnings, such as those about photos that were left out."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


@contextmanager
def record_warnings() -> Iterator[list[str]]:
    """Yields the warnings that the package logs within a block."""
    recorder, log = Recorder(), logging.getLogger("nerf_lightning")
    log.addHandler(recorder)
    try:
        yield recorder.lines
    finally:
        log.removeHandler(recorder)


def find_doubts(scene: Scene) -> list[str]:
    """What the checks before training say, refusals too."""
    try:
        return [doubt.text for doubt in check_scene(scene)]
    except InputError as error:
        return [str(error)]


def judge_photos(scene: Scene) -> tuple[list[Photo], list[tuple[int, Float[np.ndarray, "4 4"]]]]:
    """All photos in the order of their names with their troubles, and the number and pose of each."""
    train, val = look_at(scene.train, "train", 1), look_at(scene.val, "held out", 1 + len(scene.train))
    poses = [*scene.train.cameras.c2w.double().numpy(), *scene.val.cameras.c2w.double().numpy()]
    posed = list(zip([*train, *val], poses, strict=True))
    posed.sort(key=lambda pair: (not scene.train.names, pair[0].name))
    for number, (photo, _) in enumerate(posed, 1):
        photo.number = number
    photos = [photo for photo, _ in posed]
    judge(photos, not scene.bounds.unbounded)
    return photos, [(photo.number, pose) for photo, pose in posed]


def describe_scene(scene: Scene) -> dict[str, str]:
    """What the scene is."""
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
    if scene.train.known is not None:
        facts["masked"] = f"{1 - float(scene.train.known.float().mean()):.0%} of the pixels are unknown"
    elif scene.train.channels == 4:
        facts["masked"] = "photos have alpha: what is transparent is empty"
    return facts
