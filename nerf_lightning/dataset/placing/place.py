"""Plain photos become photos with known cameras: a COLMAP model that is kept beside them."""

import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path

from nerf_lightning.dataset.formats.colmap import PLACED_FOLDER
from nerf_lightning.dataset.placing.choose import FEWEST
from nerf_lightning.dataset.placing.kept import find_kept, keep, made_of
from nerf_lightning.dataset.placing.photos import find_photos
from nerf_lightning.dataset.placing.structure import reconstruct
from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require
from nerf_lightning.utils.text import join_truncated

log = logging.getLogger(__name__)

MODEL = Path("sparse") / "0"
"""The model in the folder beside the photos."""
FILES = ("cameras.bin", "images.bin", "points3D.bin")
SHOWN = 5
"""Names that a line tells at most."""
OVERLAP = "take more photos, in small steps around the subject, sharp, of something with texture; or use tags"


def place(folder: Path) -> Path:
    """Places a folder's photos by structure from motion, once: a second call with the same photos reads nothing.

    The model is about the upright, full-size photos: whoever reads them applies the EXIF rotation. Its frame, and its scale,
    are COLMAP's own.

    Args:
        folder: of photos of one scene; several sizes, cameras and focal lengths may be among them.

    Returns:
        The folder of a binary COLMAP model: `placed/sparse/0` beside the photos, or in the cache where that cannot be written.

    Raises:
        InputError: pycolmap is not installed, a photo cannot be read, or the photos do not hang together.
    """
    photos = find_photos(folder, "dataset.path")
    sources = made_of(photos)
    kept = find_kept(
        folder / PLACED_FOLDER, sources, lambda kept: all((kept / MODEL / file).is_file() for file in FILES)
    )
    if kept is not None:
        log.info("%s: cameras as an earlier run placed them, in %s", folder, kept)
        return kept / MODEL
    require("colmap", "pycolmap", purpose="the optional extra for photos without cameras")
    with tempfile.TemporaryDirectory() as workspace:
        model = reconstruct(photos, Path(workspace))
    count = 0 if model is None else model.num_reg_images()
    if model is None or count < FEWEST:
        found = f"{count} of {len(photos)} photos that hang together"
        raise InputError(folder, "", found, f"at least {FEWEST}", OVERLAP)
    placed = {image.name for image in model.images.values() if image.has_pose}

    def fill(empty: Path) -> None:
        (empty / MODEL).mkdir(parents=True)
        model.write_binary(empty / MODEL)

    target = keep(folder / PLACED_FOLDER, sources, fill)
    log.info("%s", _told(target, len(photos), [photo.name for photo in photos if photo.name not in placed]))
    return target / MODEL


def _told(target: Path, count: int, missing: Sequence[str]) -> str:
    line = f"{count - len(missing)} of {count} photos placed, kept in {target}"
    if not missing:
        return line
    return f"{line}; not placed, for they share too few points with the others: {join_truncated(missing, SHOWN)}"
