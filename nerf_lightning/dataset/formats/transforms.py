"""JSON scenes: transforms.json (nerfstudio, instant-ngp) and transforms_{train,val,test}.json (Blender, NeRF paper)."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset.formats.file_names import drop_missing, find_images, normalize_name
from nerf_lightning.dataset.formats.image_files import read_image_size
from nerf_lightning.dataset.formats.transforms_json import Frame, read_frames, read_intrinsics, read_size
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.orientation import choose_orientations
from nerf_lightning.dataset.photo_loading import DEFAULT_OPTIONS, PhotoLoadOptions, PosedPhoto
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.scene_builder import Hints, Split, build_scene
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

WHITE = (1.0, 1.0, 1.0)


def load_transforms(path: Path, name: str | None = None, options: PhotoLoadOptions = DEFAULT_OPTIONS) -> Scene:
    """Reads transforms.json: OpenGL camera-to-world poses, converted to OpenCV here.

    Frames without a photo are ignored with a warning, as in instant-ngp (whose fox has some), unless they are the majority:
    then the path is wrong. A frame's `mask_path` is its mask; without any, see `find_masks`.

    Args:
        path: transforms.json or its folder.
        name: defaults to the folder's name, or the file's if that is not transforms.json.
        options: how to read photos; frames are sorted by file_path, and the file may define the split.

    Raises:
        InputError: missing or malformed entries, or an unsupported lens.
    """
    file = path / "transforms.json" if path.is_dir() else path
    frames = sorted(read_frames(file), key=lambda frame: frame.name)
    names = [frame.name for frame in frames]
    photos = drop_missing(file, frames, find_images(file.parent, names, file))
    split = read_split(file, frames[0].values, names, [frame.name for frame, _ in photos])
    folder = file.resolve().parent
    posed_photos = make_posed_photos(file, photos, folder, options)
    name = name or (folder.name if file.stem == "transforms" else file.stem)
    return build_scene(path, name, posed_photos, options, split)


def load_blender(folder: Path, name: str | None = None, options: PhotoLoadOptions = DEFAULT_OPTIONS) -> Scene:
    """Reads transforms_train.json, transforms_val.json and transforms_test.json, the NeRF paper's Blender format.

    Every key of transforms.json is supported. The val split is held out, or test if val has no photos; with both, test is
    evaluated at the end. A split without photos is a camera path; if none is held out, every `options.holdout`-th photo of
    the train split is. The background of photos with alpha is white, the format's convention.

    Args:
        folder: folder of transforms_train.json.
        name: defaults to the folder's name.
        options: how to read photos.

    Raises:
        InputError: missing or malformed entries.
    """
    splits = {"train": read_frames(folder / "transforms_train.json")}
    for split in ("val", "test"):
        if (file := folder / f"transforms_{split}.json").is_file():
            splits[split] = read_frames(file)
    names = [frame.name for frames in splits.values() for frame in frames]
    found = dict(zip(names, find_images(folder, names, folder), strict=True))
    path: list[Frame] = []
    parts: list[list[int]] = []
    photos: list[tuple[Frame, Path]] = []
    for split, frames in splits.items():
        files = [found[frame.name] for frame in frames]
        if split != "train" and not any(files):
            log.warning("%s: %d frames without photos, used as a camera path", split, len(frames))
            path = frames
            continue
        present = drop_missing(folder / f"transforms_{split}.json", frames, files)
        parts.append(list(range(len(photos), len(photos) + len(present))))
        photos += present
    posed_photos = make_posed_photos(folder, photos, folder, options)
    if len(parts) == 1:
        log.warning("%s: no held-out photos: holding out every %d-th training photo", folder, options.holdout)
    indices = Split(*parts) if parts[1:] else None
    camera_path = make_camera_path(path, posed_photos[0].intrinsics) if path else None
    hints = Hints(WHITE, keep_frame=True, camera_path=camera_path)
    return build_scene(folder, name or folder.resolve().name, posed_photos, options, indices, hints)


def read_split(file: Path, content: Mapping[str, Any], names: Sequence[str], present: Sequence[str]) -> Split | None:
    """Reads the split defined in a file; None without one.

    Args:
        file: the file, for messages.
        content: entries of the file.
        names: names of all frames.
        present: names of the frames with a photo.

    Raises:
        InputError: a name without a frame, or a photo in two splits.
    """
    known, named = {normalize_name(name) for name in names}, dict[str, list[int]]()
    for part in ("train", "val", "test"):
        listed = content.get(key := f"{part}_filenames") or []
        if not isinstance(listed, list) or not all(isinstance(item, str) for item in listed):
            raise InputError(file, key, repr(listed)[:60], "a list of file_path strings")
        if unknown := [item for item in listed if normalize_name(item) not in known]:
            raise InputError(file, key, f"{unknown[0]!r}, which is not a frame", "the file_path of a frame")
        if members := {normalize_name(item) for item in listed}:
            named[part] = [i for i, name in enumerate(present) if normalize_name(name) in members]
    if not named:
        return None
    rest = sorted(set(range(len(present))).difference(*named.values()))
    train = named.get("train", rest)
    val, *test = [named[part] for part in ("val", "test") if named.get(part)] or [rest]
    if both := set(train) & {*val, *(i for part in test for i in part)}:
        duplicate = f"{present[min(both)]!r}, which is also in train_filenames"
        raise InputError(file, "val_filenames, test_filenames", duplicate, "photos that are not trained on")
    return Split(train, val, *(part for part in test if part != val))


def make_posed_photos(
    source: Path, photos: Sequence[tuple[Frame, Path]], folder: Path, options: PhotoLoadOptions
) -> list[PosedPhoto]:
    """Builds posed photos with intrinsics and masks."""
    sizes = [read_size(frame) for frame, _ in photos]
    orientations = choose_orientations(source, [file for _, file in photos], sizes, options.orientation)
    masks = read_masks(source, photos, folder)
    posed_photos = []
    for (frame, file), size, upright, mask in zip(photos, sizes, orientations, masks, strict=True):
        intrinsics = read_intrinsics(frame, *(size or read_image_size(file, upright)[:2]))
        posed_photos.append(PosedPhoto(frame.name, file, frame.c2w, intrinsics, mask, upright))
    return posed_photos


def read_masks(source: Path, photos: Sequence[tuple[Frame, Path]], folder: Path) -> list[Path | None]:
    """Finds the masks named by the frames, or else by `find_masks`."""
    names = [frame.values.get("mask_path") for frame, _ in photos]
    if not any(names):
        return find_masks([file for _, file in photos], folder)
    named = [str(name) for name in names if name]
    found = dict(zip(named, find_images(folder, named, source), strict=True))
    masks = [found.get(str(name)) for name in names]
    for (frame, _), name, mask in zip(photos, names, masks, strict=True):
        if name and mask is None:
            raise InputError(frame.where, "mask_path", f"no such file: {name}")
    return masks


def make_camera_path(frames: Sequence[Frame], intrinsics: Intrinsics) -> Cameras:
    """Builds pinhole cameras at the poses of frames without photos, with a photo's intrinsics."""
    c2w = torch.from_numpy(np.stack([frame.c2w for frame in frames]))
    K = torch.from_numpy(intrinsics.K).repeat(len(frames), 1, 1)
    return Cameras.pinhole(K.float(), c2w, intrinsics.width, intrinsics.height)
