"""Resolving names in scene files to files on disk."""

import unicodedata
from pathlib import Path

import pytest

from nerf_lightning.dataset.formats.file_names import find_images
from nerf_lightning.errors import InputError


def make_files(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"")
    return root


def find(root: Path, *names: str) -> list[Path | None]:
    return find_images(root, names, "file")


FOUND = {
    **{name: (name, "images/a.png") for name in ("images/a.png", "images/a", "./images/a", ".\\images\\a.png")},
    **{name: (name, "images/a.png") for name in ("Images/A.PNG", "images/a.jpg", "photos/a.png")},
    "other machine": ("/home/someone/scene/images/a.png", "images/a.png"),
    "other system": ("C:\\scans\\scene\\images\\a.png", "images/a.png"),
    "two spaces": ("images/b  c.png", "images/b  c.png"),
    "composed": (unicodedata.normalize("NFC", "images/café.png"), unicodedata.normalize("NFD", "images/café.png")),
    "nothing": ("images/z.png", None),
    "number": ("images/1", None),
}


def test_find_images_resolves_names(tmp_path: Path):
    cafe = unicodedata.normalize("NFD", "images/café.png")
    others = ("images/._a.png", "images/.DS_Store", "masks/a.png", "images_4/a.png", "images/10.png")
    root = make_files(tmp_path, "images/a.png", "images/b  c.png", cafe, *others)
    for case, (name, expected) in FOUND.items():
        assert find(root, name) == [None if expected is None else root / expected], case


def test_find_images_prefers_matching_folders(tmp_path: Path):
    root = make_files(tmp_path, "images/front/0.png", "images/back/0.png")
    assert find(root, "/data/Front/0.PNG") == [root / "images/front/0.png"]
    with pytest.raises(InputError, match=r"'0\.jpg' may mean 2 files: images/back/0\.png, images/front"):
        find(root, "0.jpg")


def test_find_images_assigns_each_file_once(tmp_path: Path):
    """Test poses without photos must not match training photos of the same number."""
    root = make_files(tmp_path, "train/1.png")
    file = root / "train/1.png"
    assert find(root, "test/1.png", "train/1.png") == [None, file]
    assert find(root, "/data/test/1.png", "/data/train/1.png") == [None, file]
    with pytest.raises(InputError, match="'a/1.png' and 'b/1.png' both match"):
        find(root, "a/1.png", "b/1.png")
