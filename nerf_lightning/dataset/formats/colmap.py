"""COLMAP folders: a sparse model, and the photos that it places."""

import logging
from pathlib import Path, PurePosixPath

import numpy as np

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.colmap_model import FILES, Image, Model, count_images, holds_model, read_model
from nerf_lightning.dataset.formats.decode import EXTENSIONS, image_header
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.optics import Optics
from nerf_lightning.dataset.posed import scene_of
from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import AS_IT_IS, Reading, Shot
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

MODEL_FOLDERS = ("sparse", "colmap/sparse", "distorted/sparse", "")
PHOTO_FOLDERS = ("images", "input", "")
REDUCED = (8, 4, 2)
"""Folders `images_8`, `images_4`, `images_2` hold the same photos at these fractions of their size."""
SHOWN = 5
"""Names in a message."""


def find_models(place: Path) -> list[Path]:
    """Folders of sparse models that a path means, the one with most photos first: itself, or those below it where COLMAP and
    the programs around it put them."""
    for base in (place / name for name in MODEL_FOLDERS):
        if base.is_dir():
            below = sorted(folder for folder in base.iterdir() if folder.name.isdigit() and folder.is_dir())
            models = [folder for folder in (base, *below) if holds_model(folder)]
            if models:
                return sorted(models, key=count_images, reverse=True)
    return []


def load_colmap(
    place: Path, name: str | None = None, reading: Reading = AS_IT_IS, photos: Path | None = None, upright: bool = False
) -> Scene:
    """Reads a COLMAP model, binary or text, with the photos it places.

    Photos are looked for in `images`, `input` or beside the model, in each folder from the model's up; `images_2`, `images_4`
    or `images_8` stand in for them where `resize` asks for no more pixels. Masks are found by `find_masks`.

    Args:
        place: the scene's folder, or the model's.
        name: defaults to the scene's folder's name.
        reading: see there.
        photos: their folder; None looks for it.
        upright: whether the model is of photos turned as their EXIF data say.

    Raises:
        InputError: no whole model, no photos, or photos that do not fit it.
    """
    models = find_models(place)
    if not models:
        expected = " and ".join(f"{file}.bin or .txt" for file in FILES[:2])
        raise InputError(place, "", "no COLMAP model", f"{expected} in it or in sparse/0")
    folder = models[0]
    if len(models) > 1:
        others = ", ".join(f"{other.name} ({count_images(other)})" for other in models[1:])
        log.warning("%s: the model with most photos (%d); others: %s", folder, count_images(folder), others)
    model = read_model(folder)
    _check(folder, model)
    images = sorted(model.images, key=lambda image: image.name)
    root = _photo_folder(folder, place, images) if photos is None else photos
    files = [_inside(folder, root, image.name) for image in images]
    there = [file.is_file() for file in files]
    missing = [image.name for image, has in zip(images, there, strict=True) if not has]
    if 2 * len(missing) > len(images):
        found = f"{missing[0]!r} not in {root} (nor {len(missing) - 1} more)"
        raise InputError(
            folder, "", found, "a photo for at least half of the images", "is the folder of photos in place?"
        )
    if missing:
        log.warning("%s: %d of %d photos are not there, %s: left out", root, len(missing), len(images), _named(missing))
    kept = [image for image, has in zip(images, there, strict=True) if has]
    _tell_unplaced(root, {image.name for image in images})
    small = _reduced(root, [model.cameras[image.camera] for image in kept], reading.resize)
    paths = [_inside(folder, small if (small / image.name).is_file() else root, image.name) for image in kept]
    scene_folder = root.parent if root.name in PHOTO_FOLDERS else root
    masks = find_masks([root / image.name for image in kept], scene_folder)
    shots = [
        Shot(
            image.name,
            path,
            checks.rigid_pose(folder, image.name, np.linalg.inv(image.w2c)),
            model.cameras[image.camera],
            mask,
            upright,
        )
        for image, path, mask in zip(kept, paths, masks, strict=True)
    ]
    return scene_of(place, name or scene_folder.resolve().name, shots, reading, points=model.points)


def _check(folder: Path, model: Model) -> None:
    """Each image has a camera that is there, and a name of its own."""
    if not model.images:
        raise InputError(folder, "images", "0 photos", "at least one placed photo")
    names: set[str] = set()
    for image in model.images:
        if image.camera not in model.cameras:
            found = f"camera {image.camera} of {image.name}, which is not there"
            raise InputError(folder, "images", found, "a camera of the model's cameras file")
        if image.name in names:
            raise InputError(folder, "images", f"two photos named {image.name}", "a name of its own for each")
        names.add(image.name)


def _photo_folder(model: Path, place: Path, images: list[Image]) -> Path:
    """The folder that holds a model's photos, or else the likeliest."""
    order = ("input", "images", "") if "distorted" in model.parts else PHOTO_FOLDERS
    above = [model, *list(model.resolve().parents)[:4]]
    tried = [parent / name for parent in above for name in order]
    for folder in tried:
        if any(_is_file(folder / image.name) for image in images[:SHOWN]):
            return folder
    return next((folder for folder in tried if folder.name and folder.is_dir() and folder.name in order), place)


def _is_file(path: Path) -> bool:
    """Whether it is one; a name too long or a loop of links is none."""
    try:
        return path.is_file()
    except OSError:
        return False


def _inside(model: Path, root: Path, name: str) -> Path:
    """The photo of this name, which may not lead out of its folder."""
    parts = PurePosixPath(name.replace("\\", "/"))
    if parts.is_absolute() or ".." in parts.parts or not parts.parts or ":" in parts.parts[0]:
        raise InputError(
            model, "images", repr(name), "names relative to the folder of photos", "place the photos again"
        )
    return root / name


def _tell_unplaced(root: Path, placed: set[str]) -> None:
    """Names photos in the folder that the model does not place."""
    try:
        files = [file.relative_to(root).as_posix() for file in root.rglob("*") if file.suffix in EXTENSIONS]
    except OSError as error:
        log.warning("%s: %s", root, error)
        return
    folders = {name.rpartition("/")[0] for name in placed}
    left = sorted(name for name in files if name not in placed and name.rpartition("/")[0] in folders)
    if left:
        log.warning("%s: %d photos have no place in the model, %s: left out", root, len(left), _named(left))


def _named(names: list[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")


def _reduced(root: Path, cameras: list[Optics], resize: int | None) -> Path:
    """A folder with the same photos reduced, still as large as asked for; the folder itself where there is none."""
    if resize is None:
        return root
    for factor in REDUCED:
        folder = root.parent / f"{root.name}_{factor}"
        first = next(iter(sorted(folder.glob("*"))), None) if folder.is_dir() else None
        if first is None or not _is_file(first):
            continue
        side = max(image_header(first)[:2])
        if all(side >= max(fit_size(one.width, one.height, resize)) for one in cameras):
            return folder
    return root
