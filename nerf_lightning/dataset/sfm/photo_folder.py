"""Photo folders: lists the photos and reconstructs their cameras."""

import logging
import tempfile
from pathlib import Path

from nerf_lightning.dataset.formats.file_names import list_images, make_natural_key
from nerf_lightning.dataset.sfm.cache import build_cached_folder
from nerf_lightning.dataset.sfm.colmap import MIN_PHOTOS, reconstruct
from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require_extra
from nerf_lightning.utils.text import join_truncated

log = logging.getLogger(__name__)

MODEL_FOLDER = Path("sparse") / "0"
MAX_NAMES = 5
"""Names in a message."""


def find_photos(folder: Path, key: str) -> list[Path]:
    """Lists the photos of a folder in natural order, without subfolders.

    Args:
        folder: folder of photos.
        key: config key of the folder, for messages.

    Raises:
        InputError: no such folder, or no photo in it.
    """
    if not folder.is_dir():
        raise InputError("config", key, f"no such folder: {folder}")
    photos = sorted(list_images(folder), key=lambda photo: make_natural_key(photo.name))
    if not photos:
        others = sorted({file.suffix.lower() for file in folder.iterdir() if file.suffix})
        found = f"only {', '.join(others)} files" if others else "no photo"
        raise InputError(folder, "", found, "JPEG, PNG, TIFF, WebP or HEIC photos", "convert them" if others else "")
    return photos


def run_sfm(folder: Path) -> Path:
    """Reconstructs a folder's photos by structure from motion; cached for the same photos.

    The model refers to the upright, full-size photos: readers apply the EXIF rotation. Frame and scale are COLMAP's.

    Args:
        folder: photos of one scene, of any sizes, cameras and focal lengths.

    Returns:
        Folder of a binary COLMAP model, in the cache.

    Raises:
        InputError: pycolmap is not installed, a photo is unreadable, or the photos are not connected by matches.
    """
    photos = find_photos(folder, "dataset.path")

    def fill(empty: Path) -> None:
        require_extra("colmap", "pycolmap", purpose="the optional extra for photos without cameras")
        with tempfile.TemporaryDirectory() as workspace:
            model = reconstruct(photos, Path(workspace))
        registered = set() if model is None else {image.name for image in model.images.values() if image.has_pose}
        if model is None or len(registered) < MIN_PHOTOS:
            found = f"{len(registered)} of {len(photos)} photos that COLMAP could register"
            hint = "take more sharp photos, in small steps around a textured subject; or use tags"
            raise InputError(folder, "", found, f"at least {MIN_PHOTOS}", hint)
        log.info("%d of %d photos registered", len(registered), len(photos))
        if missing := [photo.name for photo in photos if photo.name not in registered]:
            log.info("not registered, too few points in common: %s", join_truncated(missing, MAX_NAMES))
        (empty / MODEL_FOLDER).mkdir(parents=True)
        model.write_binary(empty / MODEL_FOLDER)

    return build_cached_folder(folder, photos, fill) / MODEL_FOLDER
