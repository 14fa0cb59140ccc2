"""Folders that are kept beside what they were made of, so that a second run does not make them again."""

import hashlib
import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic_folder, cache_folder, write_json
from nerf_lightning.utils.parsing import read_json

log = logging.getLogger(__name__)

RECORD = "made_of.json"
"""In each such folder: names, sizes in bytes and times of the last change, in nanoseconds, of the files it was made of."""


def cached_folder(beside: Path, sources: Sequence[Path], fill: Callable[[Path], None]) -> Path:
    """The folder that was made of the same files before, or is made now: beside them, or in the cache where nothing can be
    written there.

    Args:
        beside: where it stands if that can be written.
        sources: files that it is made of.
        fill: writes what belongs there into an empty folder.

    Raises:
        InputError: a folder of somebody else has that name, or neither can be written.
    """
    states = {file.name: file.stat() for file in sources}
    made_of = {name: [state.st_size, state.st_mtime_ns] for name, state in states.items()}
    folder = beside
    if not os.access(beside.parent, os.W_OK) and not beside.is_dir():
        digest = hashlib.sha256(str(beside.resolve()).encode()).hexdigest()[:16]
        folder = cache_folder() / "sfm" / digest / beside.name
        log.warning("%s cannot be written: %s is, instead", beside, folder)
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / RECORD).is_file():
            found = f"a folder without {RECORD}, which was not made here"
            raise InputError(
                folder, "", found, "nothing, or what an earlier run made", "move it elsewhere or rename it"
            )
        if read_json(folder / RECORD, "what it was made of; delete the folder to make it again") == made_of:
            log.info("%s: kept from an earlier run", folder)
            return folder
        log.info("%s was made of other files: it is made again", folder)
    with atomic_folder(folder) as temporary:
        fill(temporary)
        write_json(temporary / RECORD, made_of)
    return folder
