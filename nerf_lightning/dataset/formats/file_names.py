"""Resolves the file names that scene files contain to the files on this disk."""

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
"""Folders whose files have the photos' names and are not the photos: masks, depth maps, reduced copies such as images_4."""
MAX_FILES = 200_000
"""Most files that are listed in search of a moved one."""
MAX_SHOWN = 4
"""Names in a message."""


def is_image(name: str) -> bool:
    """By its extension; hidden files, as macOS's `._a.jpg`, are none."""
    return PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(".")


def make_natural_key(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts photo 9 before photo 10."""
    parts = filter(None, re.split(r"(\d+)", name.lower()))
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts]


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder, sorted by name."""
    return sorted(file for file in folder.iterdir() if is_image(file.name) and file.is_file())


def walk_images(root: Path) -> Iterator[Path]:
    """All image files below a folder, hidden ones and hidden folders left out."""
    count = 0
    for folder, folders, files in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        count += len(files)
        if count > MAX_FILES:
            return
        yield from (Path(folder, name) for name in sorted(files) if is_image(name))


def normalize_name(name: str) -> tuple[str, ...]:
    """The parts of a path as any system writes it, without drive, root and `.` parts, under Unicode (NFC) and case folding;
    the last without an image's extension."""
    name = unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold()).replace("\\", "/")
    parts = tuple(part for part in PurePosixPath(name).parts if part not in ("/", "//") and not part.endswith(":"))
    if parts and (suffix := PurePosixPath(parts[-1]).suffix) in IMAGE_SUFFIXES:
        return (*parts[:-1], parts[-1].removesuffix(suffix))
    return parts


def find_exact_file(root: Path, name: str) -> Path | None:
    """The file at a path relative to a folder, whose extension may be missing, as Blender exports leave it."""
    suffixes = ("", *IMAGE_SUFFIXES, *map(str.upper, IMAGE_SUFFIXES))
    return next((file for suffix in suffixes if os.path.isfile(file := root / (name + suffix))), None)


def find_images(root: Path, names: Sequence[str], where: object) -> list[Path | None]:
    """The image files that a scene file names; None where there is none.

    A name means the file at that path relative to `root`; or else the one file below `root`, meant by no other name, whose
    base name, and as many of its folders as possible, are the same under `normalize_name`. Reduced copies, masks and depth maps
    count only where nothing else has the name. A line says which names were substituted.

    Args:
        root: folder that names are relative to.
        names: as the file has them.
        where: the file, for messages.

    Raises:
        InputError: several files may be meant, or one by two names.
    """
    found = {name: find_exact_file(root, name) for name in names}
    inexact = [name for name, file in found.items() if file is None]
    exact, free = set(found.values()), dict[str, list[Path]]()
    for file in walk_images(root) if inexact else ():
        if file not in exact:
            free.setdefault(normalize_name(file.name)[-1], []).append(file)
    claims: dict[Path, list[tuple[int, str]]] = {}
    for name in inexact:
        if (closest := _find_closest(root, name, free, where)) is not None:
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
        text = "%s: %d names are not those of the files on disk; taken by their base names, such as %s for %r"
        log.warning(text, where, len(moved), *moved[0])
    return [found[name] for name in names]


def _find_closest(root: Path, name: str, free: Mapping[str, list[Path]], where: object) -> tuple[Path, int] | None:
    """The file whose folded path shares most parts with a name, from the last on, and how many."""
    wanted = normalize_name(name)
    ranks = {}
    for file in free.get(wanted[-1], []) if wanted else []:
        own = normalize_name(str(inside := file.relative_to(root)))
        shared = len(os.path.commonprefix([wanted[::-1], own[::-1]]))
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
    """The photos whose file is there, and it. A line names the others; InputError if those are the majority."""
    missing = sorted(photo.name for photo, file in zip(photos, files, strict=True) if file is None)
    if 2 * len(missing) > len(photos):
        found = f"no file for {missing[0]!r} and {len(missing) - 1} more of {len(photos)} photos"
        raise InputError(where, "", found, hint="is the folder of photos in place?")
    if missing:
        shown = join_truncated(missing, MAX_SHOWN)
        log.warning("%s: %d of %d photos are not there, %s: left out", where, len(missing), len(photos), shown)
    return [(photo, file) for photo, file in zip(photos, files, strict=True) if file is not None]
