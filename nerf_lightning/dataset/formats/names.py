"""Resolves the file names that scene files contain to the files on this disk."""

import logging
import os
import re
import unicodedata
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path, PurePosixPath

from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif")
MASK_FOLDERS = ("masks", "mask", "images_mask", "images_masks")
OTHER_FOLDERS = re.compile(r"(masks?|images_masks?|depths?|depth_maps|normals?|semantics?|.*_\d+)$", re.IGNORECASE)
"""Folders whose files have the photos' names and are not the photos: masks, depth maps, reduced copies such as images_4."""
MAX_FILES = 200_000
"""Most files that are listed in search of a moved one."""
MAX_SHOWN = 4
"""Names in a message."""


def is_image(name: str) -> bool:
    """By its extension; hidden files, as macOS's `._a.jpg`, are none."""
    return PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES and not name.startswith(".")


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder, sorted by name."""
    return sorted(file for file in folder.iterdir() if is_image(file.name) and file.is_file())


def split_name(name: str) -> tuple[str, ...]:
    """The parts of a path as any system writes it: separated by / or \\, without drive, root and `.` parts."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return tuple(part for part in parts if part not in ("/", "//", ".") and not part.endswith(":"))


def fold_part(part: str) -> str:
    """A part of a path under Unicode (NFC) and case folding."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", part).casefold())


def fold_name(name: str) -> tuple[str, ...]:
    """The folded parts of a path, the last without an image's extension."""
    parts = [fold_part(part) for part in split_name(name)]
    if parts and PurePosixPath(parts[-1]).suffix in IMAGE_SUFFIXES:
        parts[-1] = parts[-1].removesuffix(PurePosixPath(parts[-1]).suffix)
    return tuple(parts)


class ImageFinder:
    """Finds the image files that a scene file names.

    A name means the exact path relative to `root`, perhaps without its extension, as Blender exports leave it; or else the one
    file below `root` whose name, and as many of its folders as possible, are the same under Unicode and case folding, with any
    separators and apart from the extension. Reduced copies, masks and depth maps count only where nothing else has the name.

    Args:
        root: folder that names are relative to.
    """

    def __init__(self, root: Path):
        self.root = root
        self.owners: dict[Path, str] = {}
        """Files that were found, and the name that led there first."""
        self.substituted: dict[str, Path] = {}
        """Names that are not the path of the file they mean, and that file."""

    def find(self, name: str, where: object, key: str) -> Path | None:
        """The file of a name, or None where there is none. A file that another name has led to is not taken for this one.

        Raises:
            InputError: several files may be meant, or one by two names; `where` and `key` name the place of the name.
        """
        if (file := self.find_exact(name)) is None and (file := self._find_folded(name, where, key)) is not None:
            self.substituted[name] = file
        if file is None:
            return None
        if (owner := self.owners.setdefault(file, name)) != name and owner in self.substituted:
            found = f"{owner!r} and {name!r}, of which only {file.relative_to(self.root)} is there"
            raise InputError(where, key, found, "a photo for each", "is the folder of photos complete?")
        return file

    def find_exact(self, name: str) -> Path | None:
        """The file at a path relative to the root, whose extension may be missing."""
        for suffix in ("", *IMAGE_SUFFIXES, *(suffix.upper() for suffix in IMAGE_SUFFIXES)):
            try:
                if (candidate := self.root / (name + suffix)).is_file():
                    return candidate
            except (OSError, ValueError):  # a name too long, or with a zero byte
                return None
        return None

    def _find_folded(self, name: str, where: object, key: str) -> Path | None:
        wanted = fold_name(name)
        found = self._files.get(wanted[-1], []) if wanted else []
        found = [file for file in found if file not in self.owners]
        for only_photos in (True, False):
            candidates = [file for file in found if not only_photos or self._is_photo(file)]
            lengths = [self._common_tail(wanted, file) for file in candidates]
            best = [file for file, length in zip(candidates, lengths, strict=True) if length == max(lengths)]
            same_suffix = [file for file in best if file.suffix.lower() == PurePosixPath(name).suffix.lower()]
            best = same_suffix if len(same_suffix) == 1 else best
            if len(best) == 1:
                return best[0]
            if best:
                shown = ", ".join(file.relative_to(self.root).as_posix() for file in best[:MAX_SHOWN])
                found_text = f"{name!r}, which may mean {len(best)} files: {shown}"
                raise InputError(where, key, found_text, "the path of one file", "correct the path")
        return None

    def _is_photo(self, file: Path) -> bool:
        return not any(OTHER_FOLDERS.match(part) for part in file.relative_to(self.root).parts[:-1])

    def _common_tail(self, wanted: tuple[str, ...], file: Path) -> int:
        """How many parts, from the last on, a folded name and a file share."""
        own = fold_name(file.relative_to(self.root).as_posix())
        pairs = list(zip(reversed(wanted), reversed(own), strict=False))
        return next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))

    @cached_property
    def _files(self) -> dict[str, list[Path]]:
        """All image files below the root, by their folded base names."""
        found: dict[str, list[Path]] = {}
        for file in walk_images(self.root):
            found.setdefault(fold_name(file.name)[-1], []).append(file)
        return found

    def report(self, where: object) -> None:
        """Says once which names were substituted by others than their parts in this system's spelling."""
        moved = {name: file for name, file in self.substituted.items() if self.root / Path(*split_name(name)) != file}
        if not moved:
            return
        name, file = next(iter(moved.items()))
        log.warning(
            "%s: %d names are not those of the files on disk; taken by their base names, such as %s for %r",
            where,
            len(moved),
            file.relative_to(self.root).as_posix(),
            name,
        )


def walk_images(root: Path) -> Iterator[Path]:
    """All image files below a folder, hidden ones and hidden folders left out."""
    count = 0
    for folder, folders, files in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            count += 1
            if count > MAX_FILES:
                return
            if is_image(name):
                yield Path(folder, name)
