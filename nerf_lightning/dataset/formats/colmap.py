"""COLMAP folders: a sparse model, and the photos that it places."""

import logging
import os
import re
from pathlib import Path

from nerf_lightning.dataset.formats.colmap_model import FILES, Image, count_images, holds_model, read_model
from nerf_lightning.dataset.formats.names import ImageFinder, list_images, walk_images
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.orientation import OrientationChooser
from nerf_lightning.dataset.posed import Hints, build_scene
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import AS_IT_IS, Reading, Shot
from nerf_lightning.dataset.size import REDUCED
from nerf_lightning.errors import InputError
from nerf_lightning.utils.text import join_truncated

log = logging.getLogger(__name__)

MODEL_FOLDERS = ("sparse", "colmap/sparse", "distorted/sparse", "")
PHOTO_FOLDERS = ("images", "input", "")
REDUCED_NAME = re.compile(r"(images|input)_\d+$")
PLACED_FOLDER = "placed"
"""Beside plain photos: the model that this package has made of them."""
MAX_MODEL_DEPTH = 4
"""Folders below a scene's in which a model is looked for where it is in none of the usual ones."""
SHOWN = 5
"""Names in a message."""


def find_models(place: Path) -> list[Path]:
    """Folders of sparse models that a path means, the one with most photos first: itself, or those below it where COLMAP and
    the programs around it put them, such as `sparse/0`; else all down to `MAX_MODEL_DEPTH`."""
    for base in (place / name for name in MODEL_FOLDERS):
        if base.is_dir():
            below = sorted(folder for folder in base.iterdir() if folder.name.isdigit() and folder.is_dir())
            models = [folder for folder in (base, *below) if holds_model(folder)]
            if models:
                return sorted(models, key=count_images, reverse=True)
    found = []
    for name, folders, _ in os.walk(place):
        folder = Path(name)
        deepest = len(folder.relative_to(place).parts) >= MAX_MODEL_DEPTH
        folders[:] = (
            [] if deepest else sorted(one for one in folders if one != PLACED_FOLDER and not one.startswith("."))
        )
        if holds_model(folder):
            found.append(folder)
    if len({folder.parent if folder.name.isdigit() else folder for folder in found}) > 1:
        shown = ", ".join(folder.relative_to(place).as_posix() for folder in sorted(found)[:SHOWN])
        raise InputError(place, "", f"several COLMAP models: {shown}", "one", "give the path of one of them")
    return sorted(found, key=count_images, reverse=True)


def load_colmap(
    place: Path, name: str | None = None, reading: Reading = AS_IT_IS, photos: Path | None = None, upright: bool = False
) -> Scene:
    """Reads a COLMAP model, binary or text, with the photos it places.

    Photos are looked for in `images`, `input` or beside the model, in each folder from the model's up. Masks are found by
    `find_masks`.

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
    if not model.images:
        raise InputError(folder, "images", "0 photos", "at least one placed photo")
    for image in model.images:
        if image.camera not in model.cameras:
            found = f"camera {image.camera} of {image.name}, which is not there"
            raise InputError(folder, "images", found, "a camera of the model's cameras file")
    if len({image.name for image in model.images}) < len(model.images):
        raise InputError(folder, "images", "two photos of one name", "a name of its own for each")
    images = sorted(model.images, key=lambda image: image.name)
    root = find_photo_folder(folder, place, images) if photos is None else photos
    finder = ImageFinder(root)
    files = [finder.find(image.name, folder, "images") for image in images]
    missing = [image.name for image, file in zip(images, files, strict=True) if file is None]
    if 2 * len(missing) > len(images):
        found = f"{missing[0]!r} not in {root} (nor {len(missing) - 1} more)"
        raise InputError(
            folder, "", found, "a photo for at least half of the images", "is the folder of photos in place?"
        )
    finder.report(folder)
    if missing:
        log.warning(
            "%s: %d of %d photos are not there, %s: left out",
            root,
            len(missing),
            len(images),
            join_truncated(missing, SHOWN),
        )
    found_files = [(image, file) for image, file in zip(images, files, strict=True) if file is not None]
    report_unplaced(root, [file for _, file in found_files])
    scene_folder = root.parent if root.name in PHOTO_FOLDERS or REDUCED_NAME.match(root.name) else root
    masks = find_masks([file for _, file in found_files], scene_folder)
    orientation = OrientationChooser(reading.orientation)
    shots = []
    for (image, file), mask in zip(found_files, masks, strict=True):
        optics = model.cameras[image.camera]
        turned = upright or orientation.choose(file, (optics.width, optics.height))[2]
        shots.append(Shot(image.name, file, image.c2w, optics, mask, turned))
    orientation.report(folder)
    named = place if scene_folder.resolve().is_relative_to(place.resolve()) else scene_folder
    return build_scene(place, name or named.resolve().name, shots, reading, hints=Hints(points=model.points))


def find_photo_folder(model: Path, place: Path, images: list[Image]) -> Path:
    """The folder that holds a model's photos: `images`, `input`, itself or `images_2` to `images_8`, from the model's up."""
    order = ("input", "images", "") if "distorted" in model.parts else PHOTO_FOLDERS
    above = [model, *list(model.resolve().parents)[:4]]
    reduced = [f"{name}_{factor}" for name in ("images", "input") for factor in reversed(REDUCED)]
    tried = [parent / name for names in (order, reduced) for parent in above for name in names]
    for folder in tried:
        if any(ImageFinder(folder).find_exact(image.name) for image in images[:SHOWN]):
            return folder
    return next((folder for folder in tried if folder.name in (*order, *reduced) and has_images(folder)), place)


def has_images(folder: Path) -> bool:
    """Whether there is an image file in a folder or below it."""
    return folder.is_dir() and next(walk_images(folder), None) is not None


def report_unplaced(root: Path, placed: list[Path]) -> None:
    """Names photos beside the placed ones that the model does not place."""
    folders = {file.parent for file in placed}
    left = sorted({file for folder in folders for file in list_images(folder)} - set(placed))
    if left:
        names = [file.relative_to(root).as_posix() for file in left]
        log.warning(
            "%s: %d photos have no place in the model, %s: left out", root, len(left), join_truncated(names, SHOWN)
        )
