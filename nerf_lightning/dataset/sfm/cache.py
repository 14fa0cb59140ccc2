"""Folders in the cache that keep what was made of photos or a video, so that a second run does not make it again."""

import hashlib
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from nerf_lightning.utils.files import atomic_write_folder, cache_folder, write_json
from nerf_lightning.utils.parsing import read_json

log = logging.getLogger(__name__)

RECORD_FILE = "made_of.json"
"""In each such folder: names, sizes in bytes and times of the last change, in nanoseconds, of the files it was made of."""


def build_cached_folder(source: Path, files: Sequence[Path], fill: Callable[[Path], None]) -> Path:
    """The folder that was made of the same files before, or is made now.

    Args:
        source: what the user named, which tells folders apart.
        files: that it is made of.
        fill: writes what belongs there into an empty folder.
    """
    states = {file.name: file.stat() for file in files}
    made_of = {name: [state.st_size, state.st_mtime_ns] for name, state in states.items()}
    folder = cache_folder() / "sfm" / hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:16]
    if (folder / RECORD_FILE).is_file():
        if read_json(folder / RECORD_FILE, "what it was made of; delete the folder to make it again") == made_of:
            log.info("%s: kept from an earlier run", folder)
            return folder
        log.info("%s was made of other files: it is made again", folder)
    with atomic_write_folder(folder) as temporary:
        fill(temporary)
        write_json(temporary / RECORD_FILE, made_of)
    return folder
