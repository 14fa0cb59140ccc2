"""Results that are kept beside what they were made of, so that a second run does not make them again."""

import hashlib
import logging
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from nerf_lightning.errors import InputError, NoRoom
from nerf_lightning.utils.files import atomic_folder, cache_folder, write_json
from nerf_lightning.utils.parsing import read_json

log = logging.getLogger(__name__)

RECORD = "made_of.json"
"""In each such folder: what it was made of."""


def made_of(files: Iterable[Path]) -> dict[str, Any]:
    """What tells whether files are the same as before: names, sizes in bytes, and times of the last change in nanoseconds."""
    states = {file.name: file.stat() for file in files}
    return {name: [state.st_size, state.st_mtime_ns] for name, state in states.items()}


def kept_folder(
    beside: Path, sources: dict[str, Any], is_whole: Callable[[Path], bool], fill: Callable[[Path], None]
) -> Path:
    """The folder that was made of the same sources before, or is made now: beside them, or in the cache where that cannot be
    written.

    Args:
        beside: where it stands if that can be written.
        sources: what it must have been made of, as plain values.
        is_whole: whether a folder still holds what belongs there.
        fill: writes what belongs there into an empty folder.

    Raises:
        InputError: a folder of somebody else has that name, or neither can be written.
    """
    digest = hashlib.sha256(str(beside.resolve()).encode()).hexdigest()[:16]
    cached = cache_folder() / "placing" / digest / beside.name
    for folder in (beside, cached):
        if not folder.is_dir() or not any(folder.iterdir()):
            continue
        if not (folder / RECORD).is_file():
            found = f"a folder without {RECORD}, which was not made here"
            raise InputError(
                folder, "", found, "nothing, or what an earlier run made", "move it elsewhere or rename it"
            )
        if _read(folder / RECORD) == sources and is_whole(folder):
            log.info("%s: kept from an earlier run", folder)
            return folder
        log.info("%s was made of other files, or is not whole: it is made again", folder)
    try:
        return _filled(beside, sources, fill)
    except (OSError, NoRoom) as error:
        log.warning("%s cannot be written (%s): %s is, instead", beside, _reason(error), cached)
    try:
        return _filled(cached, sources, fill)
    except (OSError, NoRoom) as error:
        todo = "set NERF_LIGHTNING_CACHE to one that can"
        raise InputError(cached, "", _reason(error), "a folder that can be written", todo) from error


def _reason(error: OSError | NoRoom) -> str:
    return error.found if isinstance(error, NoRoom) else str(error.strerror)


def _filled(folder: Path, sources: dict[str, Any], fill: Callable[[Path], None]) -> Path:
    with atomic_folder(folder) as temporary:
        fill(temporary)
        write_json(temporary / RECORD, sources)
    return folder


def _read(record: Path) -> Any:
    """None where it cannot be read: it fits no sources then."""
    try:
        return read_json(record, "what it was made of")
    except InputError:
        return None
