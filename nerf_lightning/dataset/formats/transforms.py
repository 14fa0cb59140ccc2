"""Posed photos in JSON: transforms.json of nerfstudio and instant-ngp, transforms_{train,val,test}.json of the NeRF paper."""

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

    Frames whose photo is not there are left out with a warning, as instant-ngp does (its own fox is shipped so), unless
    they are the majority: then the path is wrong. A frame's `mask_path` is its mask; without any, see `find_masks`.

    Args:
        path: transforms.json or the folder that holds it.
        name: defaults to the folder's name, or the file's if that is not transforms.json.
        options: see there; frames are sorted by file_path, and the file may name its own split.

    Raises:
        InputError: anything missing or malformed, or a lens that is not known here.
    """
    file = path / "transforms.json" if path.is_dir() else path
    frames = sorted(read_frames(file), key=lambda frame: frame.name)
    names = [frame.name for frame in frames]
    photos = drop_missing(file, frames, find_images(file.parent, names, file))
    split = read_split(file, frames[0].values, names, [frame.name for frame, _ in photos])
    folder = file.resolve().parent
    shots = make_posed_photos(file, photos, folder, options)
    return build_scene(path, name or (folder.name if file.stem == "transforms" else file.stem), shots, options, split)


def load_blender(folder: Path, name: str | None = None, options: PhotoLoadOptions = DEFAULT_OPTIONS) -> Scene:
    """Reads transforms_train.json, transforms_val.json and transforms_test.json, as the NeRF paper's renders have them.

    Every key of transforms.json counts. Held out is the val split, or test where val has no photos; with both, test is
    measured on at the end. A split whose photos are not there is a camera path; where no photos are held out, every
    `options.holdout`-th of the train split is. Photos with alpha stand on white, the format's convention.

    Args:
        folder: holds transforms_train.json.
        name: defaults to the folder's name.
        options: see there.

    Raises:
        InputError: anything missing or malformed.
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
            log.warning("%s: none of its %d photos is there: taken as a camera path", split, len(frames))
            path = frames
            continue
        present = drop_missing(folder / f"transforms_{split}.json", frames, files)
        parts.append(list(range(len(photos), len(photos) + len(present))))
        photos += present
    shots = make_posed_photos(folder, photos, folder, options)
    if len(parts) == 1:
        log.warning("%s: no held-out photos: every %d-th training photo is held out", folder, options.holdout)
    parted = Split(*parts) if parts[1:] else None
    hints = Hints(WHITE, keep_frame=True, camera_path=make_camera_path(path, shots[0].intrinsics) if path else None)
    return build_scene(folder, name or folder.resolve().name, shots, options, parted, hints)


def read_split(file: Path, content: Mapping[str, Any], names: Sequence[str], present: Sequence[str]) -> Split | None:
    """The split that a file names; None where it names none.

    Args:
        file: for messages.
        content: what it says.
        names: of all its frames.
        present: those with a photo.

    Raises:
        InputError: names that are no frame's, or photos in two parts of it.
    """
    known, named = {normalize_name(name) for name in names}, dict[str, list[int]]()
    for part in ("train", "val", "test"):
        given = content.get(key := f"{part}_filenames") or []
        if not isinstance(given, list) or not all(isinstance(item, str) for item in given):
            raise InputError(file, key, repr(given)[:60], "a list of file_path strings")
        if strangers := [item for item in given if normalize_name(item) not in known]:
            raise InputError(file, key, f"{strangers[0]!r}, which is no frame", "the file_path of a frame")
        if wanted := {normalize_name(item) for item in given}:
            named[part] = [i for i, name in enumerate(present) if normalize_name(name) in wanted]
    if not named:
        return None
    rest = sorted(set(range(len(present))).difference(*named.values()))
    train = named.get("train", rest)
    val, *test = [named[part] for part in ("val", "test") if named.get(part)] or [rest]
    if both := set(train) & {*val, *(i for part in test for i in part)}:
        twice = f"{present[min(both)]!r}, which is in train_filenames too"
        raise InputError(file, "val_filenames, test_filenames", twice, "held-out photos of their own")
    return Split(train, val, *(part for part in test if part != val))


def make_posed_photos(
    source: Path, photos: Sequence[tuple[Frame, Path]], folder: Path, options: PhotoLoadOptions
) -> list[PosedPhoto]:
    """Posed photos with their intrinsics and masks."""
    stated = [read_size(frame) for frame, _ in photos]
    turned = choose_orientations(source, [file for _, file in photos], stated, options.orientation)
    masks = read_masks(source, photos, folder)
    shots = []
    for (frame, file), size, upright, mask in zip(photos, stated, turned, masks, strict=True):
        intrinsics = read_intrinsics(frame, *(size or read_image_size(file, upright)[:2]))
        shots.append(PosedPhoto(frame.name, file, frame.c2w, intrinsics, mask, upright))
    return shots


def read_masks(source: Path, photos: Sequence[tuple[Frame, Path]], folder: Path) -> list[Path | None]:
    """The masks that frames name, or else those found beside the photos."""
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
    """Pinhole cameras along the poses of frames without photos, with the intrinsics of a photo."""
    c2w = torch.from_numpy(np.stack([frame.c2w for frame in frames]))
    K = torch.from_numpy(intrinsics.K).repeat(len(frames), 1, 1)
    return Cameras.pinhole(K.float(), c2w, intrinsics.width, intrinsics.height)
