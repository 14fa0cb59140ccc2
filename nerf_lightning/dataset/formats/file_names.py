"""Resolves file names in scene files to files on disk."""

import logging
import os
import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Protocol, TypeVar, runtime_checkable

from nerf_lightning.errors import InputError
from nerf_lightning.utils.text import join_truncated

log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif")
MASK_FOLDERS = ("masks", "mask", "images_mask", "images_masks")
NON_PHOTO_FOLDERS = re.compile(r"(masks?|images_masks?|depths?|depth_maps|normals?|semantics?|.*_\d+)$", re.IGNORECASE)
"""Folders whose files share the photos' names: masks, depth maps, reduced copies such as images_4."""
MAX_FILES = 200_000
"""Files listed at most when searching for a moved one."""
MAX_SHOWN = 4
"""Names in a message."""


def is_image(name: str) -> bool:
    """Whether the extension is an image's; False for hidden files, such as macOS's `._a.jpg`."""
    return PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(".")


def make_natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts photo 9 before photo 10."""
    parts = filter(None, re.split(r"(\d+)", name.lower()))
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def list_images(folder: Path) -> list[Path]:
    """Lists the image files of a folder, sorted by name."""
    return sorted(file for file in folder.iterdir() if is_image(file.name) and file.is_file())


def walk_images(root: Path) -> Iterator[Path]:
    """Iterates over all image files below a folder, except hidden files and folders."""
    count = 0
    for folder, folders, files in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        count += len(files)
        if count > MAX_FILES:
            return
        yield from (Path(folder, name) for name in sorted(files) if is_image(name))


def normalize_name(name: str) -> tuple[str, ...]:
    """Splits a path of any system into parts, NFC-normalized and case-folded, without drive, root, `.` and image extension."""
    name = unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold()).replace("\\", "/")
    parts = tuple(part for part in PurePosixPath(name).parts if part not in ("/", "//") and not part.endswith(":"))
    if parts and (suffix := PurePosixPath(parts[-1]).suffix) in IMAGE_SUFFIXES:
        return (*parts[:-1], parts[-1].removesuffix(suffix))
    return parts


def find_exact_file(root: Path, name: str) -> Path | None:
    """Finds the file at a relative path, whose extension may be missing, as in Blender exports."""
    suffixes = ("", *IMAGE_SUFFIXES, *map(str.upper, IMAGE_SUFFIXES))
    return next((file for suffix in suffixes if os.path.isfile(file := root / (name + suffix))), None)


def find_images(root: Path, names: Sequence[str], where: object) -> list[Path | None]:
    """Finds the image files named in a scene file; None for missing ones.

    A name refers to the file at that path relative to `root`; or else to the file below `root` with the same base name, and
    the most matching parent folders, under `normalize_name`. Reduced copies, masks and depth maps match only if nothing else
    does. Substitutions are logged.

    Args:
        root: folder that names are relative to.
        names: as in the file.
        where: the file, for messages.

    Raises:
        InputError: a name matches several files, or two names one file.
    """
    found = {name: find_exact_file(root, name) for name in names}
    inexact = [name for name, file in found.items() if file is None]
    exact, unclaimed = set(found.values()), dict[str, list[Path]]()
    for file in walk_images(root) if inexact else ():
        if file not in exact:
            unclaimed.setdefault(normalize_name(file.name)[-1], []).append(file)
    claims: dict[Path, list[tuple[int, str]]] = {}
    for name in inexact:
        if (closest := _find_closest(root, name, unclaimed, where)) is not None:
            file, length = closest
            claims.setdefault(file, []).append((length, name))
    moved = []
    for file, claimants in claims.items():
        (length, name), *others = sorted(claimants, reverse=True)
        if others and others[0][0] == length:
            both = f"{others[0][1]!r} and {name!r} both match {file.relative_to(root)} alone"
            raise InputError(where, "", both, hint="is the folder of photos complete?")
        found[name] = file
        inside = file.relative_to(root)
        if PurePosixPath(name.replace("\\", "/")) not in (inside, inside.with_suffix("")):
            moved.append((inside.as_posix(), name))
    if moved:
        text = "%s: %d names do not match files on disk; matched by base name, such as %s for %r"
        log.warning(text, where, len(moved), *moved[0])
    return [found[name] for name in names]


def _find_closest(root: Path, name: str, unclaimed: Mapping[str, list[Path]], where: object) -> tuple[Path, int] | None:
    """Finds the file whose normalized path shares most trailing parts with a name, and their number."""
    target = normalize_name(name)
    ranks = {}
    for file in unclaimed.get(target[-1], []) if target else []:
        parts = normalize_name(str(inside := file.relative_to(root)))
        shared = len(os.path.commonprefix([target[::-1], parts[::-1]]))
        is_photo = not any(map(NON_PHOTO_FOLDERS.match, inside.parts[:-1]))
        ranks[file] = (shared, is_photo, file.suffix.lower() == PurePosixPath(name).suffix.lower())
    best = [file for file, rank in ranks.items() if rank == max(ranks.values())]
    if len(best) > 1:
        shown = ", ".join(file.relative_to(root).as_posix() for file in best[:MAX_SHOWN])
        raise InputError(where, "", f"{name!r} may mean {len(best)} files: {shown}", hint="name one by its path")
    return (best[0], ranks[best[0]][0]) if best else None


@runtime_checkable
class HasName(Protocol):
    @property
    def name(self) -> str: ...


Photo = TypeVar("Photo", bound=HasName)


def drop_missing(where: object, photos: Sequence[Photo], files: Sequence[Path | None]) -> list[tuple[Photo, Path]]:
    """Drops photos without a file, with a warning; raises InputError if they are the majority."""
    missing = sorted(photo.name for photo, file in zip(photos, files, strict=True) if file is None)
    if 2 * len(missing) > len(photos):
        found = f"no file for {missing[0]!r} and {len(missing) - 1} more of {len(photos)} photos"
        raise InputError(where, "", found, hint="is the folder of photos in place?")
    if missing:
        shown = join_truncated(missing, MAX_SHOWN)
        log.warning("%s: ignoring %d of %d photos without a file: %s", where, len(missing), len(photos), shown)
    return [(photo, file) for photo, file in zip(photos, files, strict=True) if file is not None]
