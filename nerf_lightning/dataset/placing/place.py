"""Plain photos become photos with known cameras: a COLMAP model that is kept beside them."""

import logging
import tempfile
from pathlib import Path

from nerf_lightning.dataset.formats.colmap import PLACED_FOLDER
from nerf_lightning.dataset.placing.choose import FEWEST
from nerf_lightning.dataset.placing.kept import kept_folder, made_of
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

    def fill(empty: Path) -> None:
        require("colmap", "pycolmap", purpose="the optional extra for photos without cameras")
        with tempfile.TemporaryDirectory() as workspace:
            model = reconstruct(photos, Path(workspace))
        count = 0 if model is None else model.num_reg_images()
        if model is None or count < FEWEST:
            found = f"{count} of {len(photos)} photos that hang together"
            raise InputError(folder, "", found, f"at least {FEWEST}", OVERLAP)
        placed = {image.name for image in model.images.values() if image.has_pose}
        log.info("%d of %d photos placed", len(placed), len(photos))
        if missing := [photo.name for photo in photos if photo.name not in placed]:
            log.info("not placed, for they share too few points with the others: %s", join_truncated(missing, SHOWN))
        (empty / MODEL).mkdir(parents=True)
        model.write_binary(empty / MODEL)

    def is_whole(kept: Path) -> bool:
        return all((kept / MODEL / file).is_file() for file in FILES)

    return kept_folder(folder / PLACED_FOLDER, made_of(photos), is_whole, fill) / MODEL
