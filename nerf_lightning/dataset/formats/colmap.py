"""COLMAP folders: a sparse model and its registered photos."""

import logging
import os
from pathlib import Path

from nerf_lightning.dataset.formats.colmap_model import MODEL_FILES, find_model_files, read_model
from nerf_lightning.dataset.formats.file_names import drop_missing, find_images, list_images, walk_images
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.orientation import choose_orientations
from nerf_lightning.dataset.photo_loading import DEFAULT_OPTIONS, PhotoLoadOptions, PosedPhoto
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.scene_builder import Hints, build_scene
from nerf_lightning.errors import InputError
from nerf_lightning.utils.text import join_truncated

log = logging.getLogger(__name__)

MODEL_FOLDERS = ("sparse", "colmap/sparse", "distorted/sparse", "")
PHOTO_FOLDERS = ("images", "input", "")
REDUCED_FOLDERS = tuple(f"{name}_{factor}" for name in ("images", "input") for factor in (2, 4, 8))
MAX_MODEL_DEPTH = 4
"""Search depth for models below the scene's folder."""
MAX_SHOWN = 5
"""Names in a message."""


def find_models(source: Path) -> list[Path]:
    """Finds sparse models at or below a path, largest first: in the standard folders, such as `sparse/0`; else in the only
    folder down to `MAX_MODEL_DEPTH` that has any."""
    found: dict[Path, list[Path]] = {}  # by the folder of `0`, `1`, or of the model itself
    for name, folders, _ in os.walk(source):
        folder = Path(name)
        if len(folder.relative_to(source).parts) >= MAX_MODEL_DEPTH:
            folders.clear()
        folders[:] = sorted(below for below in folders if not below.startswith("."))
        if find_model_files(folder):
            is_numbered = folder.name.isdigit() and folder != source
            found.setdefault(folder.parent if is_numbered else folder, []).append(folder)
    standard = [source / name for name in MODEL_FOLDERS if source / name in found]
    if not standard and len(found) > 1:
        shown = ", ".join(folder.relative_to(source).as_posix() for folder in sorted(found)[:MAX_SHOWN])
        raise InputError(source, "", f"several COLMAP models: {shown}", hint="give the path of one")
    models = found[next(iter(standard or found))] if found else []
    return sorted(models, key=lambda model: find_model_files(model)[1].stat().st_size, reverse=True)


def load_colmap(
    source: Path, name: str | None = None, options: PhotoLoadOptions = DEFAULT_OPTIONS, photos: Path | None = None
) -> Scene:
    """Reads a COLMAP model (world-to-camera poses, inverted here) and its photos, sorted by name.

    Searches for photos in `images`, `input` or the model's folder, from there up, and for masks by `find_masks`.

    Args:
        source: folder of the scene or the model.
        name: defaults to the name of the scene's folder.
        options: how to read photos.
        photos: folder of the photos; None searches for it.

    Raises:
        InputError: an incomplete model, no photos, or photos that do not match it.
    """
    models = find_models(source)
    if not models:
        expected = " and ".join(f"{file}.bin or .txt" for file in MODEL_FILES[:2])
        raise InputError(source, "", f"no COLMAP model: neither here nor in sparse/0 are {expected}")
    folder = models[0]
    if len(models) > 1:
        log.warning("%s: using the largest model; others: %s", folder, ", ".join(other.name for other in models[1:]))
    images, points = read_model(folder)
    images.sort(key=lambda image: image.name)
    names = [image.name for image in images]
    root = photos or find_photo_folder(folder, source, names)
    registered = drop_missing(folder, images, find_images(root, names, folder))
    files = [file for _, file in registered]
    warn_unregistered(root, files)
    scene_folder = root.parent if root.name in (*PHOTO_FOLDERS, *REDUCED_FOLDERS) else root
    sizes = [(image.intrinsics.width, image.intrinsics.height) for image, _ in registered]
    upright = choose_orientations(folder, files, sizes, options.orientation)
    posed_photos = [
        PosedPhoto(image.name, file, image.c2w, image.intrinsics, mask, turn)
        for (image, file), mask, turn in zip(registered, find_masks(files, scene_folder), upright, strict=True)
    ]
    named = source if scene_folder.resolve().is_relative_to(source.resolve()) else scene_folder
    return build_scene(source, name or named.resolve().name, posed_photos, options, hints=Hints(points=points))


def find_photo_folder(model: Path, source: Path, names: list[str]) -> Path:
    """Finds a model's photos: `images`, `input`, the folder itself or `images_2` to `images_8`, from the model's up."""
    order = ("input", "images", "") if "distorted" in model.parts else PHOTO_FOLDERS
    parents = [model, *list(model.resolve().parents)[:4]]
    candidates = [parent / name for names in (order, REDUCED_FOLDERS) for parent in parents for name in names]
    for folder in candidates:
        if any(os.path.isfile(folder / name) for name in names[:MAX_SHOWN]):
            return folder
    named = [folder for folder in candidates if folder.name in (*order, *REDUCED_FOLDERS)]
    return next((folder for folder in named if next(walk_images(folder), None)), source)


def warn_unregistered(root: Path, registered: list[Path]) -> None:
    """Warns about photos in the folders of the registered ones that are not in the model."""
    files = {file for folder in {file.parent for file in registered} for file in list_images(folder)}
    unregistered = sorted(files - set(registered))
    if unregistered:
        names = join_truncated([file.name for file in unregistered], MAX_SHOWN)
        log.warning("%s: ignoring %d photos that are not in the model: %s", root, len(unregistered), names)
