"""A folder of photos: which files, in which order, and where their cameras stood."""

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
"""The model in the cached folder."""
MAX_NAMES = 5
"""That a line lists."""


def find_photos(folder: Path, key: str) -> list[Path]:
    """The photos in a folder in natural order, without those in folders below it.

    Args:
        folder: where they are.
        key: the config key that named it, for the message.

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
    """Places a folder's photos by structure from motion, once: a second call with the same photos reads nothing.

    The model is about the upright, full-size photos: whoever reads them applies the EXIF rotation. Its frame, and its scale,
    are COLMAP's own.

    Args:
        folder: of photos of one scene; several sizes, cameras and focal lengths may be among them.

    Returns:
        The folder of a binary COLMAP model, in the cache.

    Raises:
        InputError: pycolmap is not installed, a photo cannot be read, or the photos do not hang together.
    """
    photos = find_photos(folder, "dataset.path")

    def fill(empty: Path) -> None:
        require_extra("colmap", "pycolmap", purpose="the optional extra for photos without cameras")
        with tempfile.TemporaryDirectory() as workspace:
            model = reconstruct(photos, Path(workspace))
        placed = set() if model is None else {image.name for image in model.images.values() if image.has_pose}
        if model is None or len(placed) < MIN_PHOTOS:
            found = f"{len(placed)} of {len(photos)} photos that hang together"
            advice = (
                "take more photos, in small steps around the subject, sharp, of something with texture; or use tags"
            )
            raise InputError(folder, "", found, f"at least {MIN_PHOTOS}", advice)
        log.info("%d of %d photos placed", len(placed), len(photos))
        if missing := [photo.name for photo in photos if photo.name not in placed]:
            names = join_truncated(missing, MAX_NAMES)
            log.info("not placed, for they share too few points with the others: %s", names)
        (empty / MODEL_FOLDER).mkdir(parents=True)
        model.write_binary(empty / MODEL_FOLDER)

    return build_cached_folder(folder, photos, fill) / MODEL_FOLDER
