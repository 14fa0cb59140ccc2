"""Cache of reconstructions and video frames, so that later runs reuse them."""

import hashlib
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from nerf_lightning.utils.files import atomic_write_folder, cache_folder, write_json
from nerf_lightning.utils.parsing import read_json

log = logging.getLogger(__name__)

RECORD_FILE = "made_of.json"
"""File in each cached folder: names, sizes in bytes and modification times in ns of its source files."""


def build_cached_folder(source: Path, files: Sequence[Path], fill: Callable[[Path], None]) -> Path:
    """Returns the cached folder for the files, building it if needed.

    Args:
        source: path given by the user, the cache key.
        files: source files, whose changes invalidate the folder.
        fill: writes the contents into an empty folder.
    """
    stats = {file.name: file.stat() for file in files}
    record = {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()}
    folder = cache_folder() / "sfm" / hashlib.sha256(str(source.resolve()).encode()).hexdigest()[:16]
    if (folder / RECORD_FILE).is_file():
        if read_json(folder / RECORD_FILE, "the record of its source files; delete the folder to rebuild it") == record:
            log.info("%s: reused from an earlier run", folder)
            return folder
        log.info("%s: rebuilding, the source files changed", folder)
    with atomic_write_folder(folder) as temporary:
        fill(temporary)
        write_json(temporary / RECORD_FILE, record)
    return folder
