"""Posed photos in JSON: transforms.json of nerfstudio and instant-ngp, transforms_{train,val,test}.json of the NeRF paper."""

import logging
from pathlib import Path

import numpy as np
import torch

from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.frames import Frame, drop_missing, read_frames
from nerf_lightning.dataset.formats.intrinsics import read_optics, read_size
from nerf_lightning.dataset.formats.names import ImageFinder, fold_name
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.optics import Optics
from nerf_lightning.dataset.orientation import OrientationChooser
from nerf_lightning.dataset.posed import Hints, Split, build_scene, split_shots
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import AS_IT_IS, Reading, Shot
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

WHITE = (1.0, 1.0, 1.0)


def load_transforms(path: Path, name: str | None = None, reading: Reading = AS_IT_IS) -> Scene:
    """Reads transforms.json: OpenGL camera-to-world poses, converted to OpenCV here.

    Frames whose photo is not there are left out with a warning, as instant-ngp does (its own fox is shipped so), unless
    they are the majority: then the path is wrong. A frame's `mask_path` is its mask; without any, see `find_masks`.

    Args:
        path: transforms.json or the folder that holds it.
        name: defaults to the folder's name, or the file's if that is not transforms.json.
        reading: see there; frames are sorted by file_path, and the file may name its own split.

    Raises:
        InputError: anything missing or malformed, or a lens that is not known here.
    """
    file = path / "transforms.json" if path.is_dir() else path
    frames = sorted(drop_missing(file, read_frames(file, ImageFinder(file.parent))), key=lambda frame: frame.name)
    folder = file.resolve().parent
    split = read_split(frames) or split_shots(file, len(frames), reading.holdout)
    shots = read_cameras(file, frames, folder, reading)
    return build_scene(path, name or (folder.name if file.stem == "transforms" else file.stem), shots, reading, split)


def load_blender(folder: Path, name: str | None = None, reading: Reading = AS_IT_IS) -> Scene:
    """Reads transforms_train.json, transforms_val.json and transforms_test.json, as the NeRF paper's renders have them.

    Every key of transforms.json counts. Held out is the val split, or test where val has no photos; with both, test is
    measured on at the end. A split whose photos are not there is a camera path; where no photos are held out, every
    `reading.holdout`-th of the train split is. Photos with alpha stand on white, the format's convention.

    Args:
        folder: holds transforms_train.json.
        name: defaults to the folder's name.
        reading: see there.

    Raises:
        InputError: anything missing or malformed.
    """
    finder = ImageFinder(folder)
    frames: list[Frame] = []
    indices: dict[str, list[int]] = {}
    path = None
    for split in ("train", "val", "test"):
        file = folder / f"transforms_{split}.json"
        if split != "train" and not file.is_file():
            continue
        found = read_frames(file, finder)
        if split != "train" and not any(frame.image for frame in found):
            log.warning("%s: none of its %d photos is there: taken as a camera path", file, len(found))
            path = found if path is None or split == "test" else path
            continue
        found = drop_missing(file, found)
        indices[split] = list(range(len(frames), len(frames) + len(found)))
        frames += found
    shots = read_cameras(folder, frames, folder, reading)
    held_out = [indices[key] for key in ("val", "test") if key in indices]
    if held_out:
        parts = Split(indices["train"], held_out[0], held_out[1] if len(held_out) > 1 else [])
    else:
        parts = split_shots(folder, len(frames), reading.holdout)
        log.warning("%s: no held-out photos: every %d-th training photo is held out", folder, reading.holdout)
    cameras = None if path is None else make_path(path, shots[0].optics)
    hints = Hints(alpha_background=WHITE, keep_frame=True, path=cameras)
    return build_scene(folder, name or folder.resolve().name, shots, reading, parts, hints)


def read_split(frames: list[Frame]) -> Split | None:
    """The split that a file names; None where it names none.

    Raises:
        InputError: names that are no frame's, or photos in two parts of it.
    """
    if not frames:
        return None
    file, content = frames[0].file, frames[0].content
    every = {fold_name(entry["file_path"]) for entry in content["frames"]}
    named: dict[str, list[int]] = {}
    for part in ("train", "val", "test"):
        key = f"{part}_filenames"
        given = content.get(key) or []
        if not isinstance(given, list) or not all(isinstance(item, str) for item in given):
            raise InputError(file, key, repr(given)[:60], "a list of file_path strings")
        if strangers := [item for item in given if fold_name(item) not in every]:
            raise InputError(file, key, f"{strangers[0]!r}, which is no frame", "the file_path of a frame")
        if given:
            names = {fold_name(item) for item in given}
            named[part] = [i for i, frame in enumerate(frames) if fold_name(frame.name) in names]
    if not named:
        return None
    rest = [i for i in range(len(frames)) if not any(i in part for part in named.values())]
    train = named.get("train", rest)
    held_out = [named[part] for part in ("val", "test") if named.get(part)] or [rest]
    for views in held_out:
        if both := sorted(set(views) & set(train)):
            found = f"{frames[both[0]].name!r}, which is in train_filenames too"
            raise InputError(file, "val_filenames, test_filenames", found, "held-out photos of their own")
    checks.split_size(file, "train split", len(train))
    checks.split_size(file, "val split", len(held_out[0]))
    test = held_out[1] if len(held_out) > 1 and held_out[1] != held_out[0] else []
    return Split(train, held_out[0], test)


def read_cameras(source: Path, frames: list[Frame], folder: Path, reading: Reading) -> list[Shot]:
    """The posed photos of frames that have one.

    Raises:
        InputError: intrinsics or masks that are none.
    """
    orientation = OrientationChooser(reading.orientation)
    shots: list[Shot] = []
    masks = read_mask_paths(frames, folder)
    for frame, mask in zip(frames, masks, strict=True):
        assert frame.image is not None  # the others were left out
        stated = read_size(frame)
        width, height, upright = orientation.choose(frame.image, stated)
        if stated is not None and stated != (width, height) and not shots:
            text = "%s: intrinsics are of photos of %dx%d; they are scaled to the photos there, of %dx%d"
            log.warning(text, source, *stated, width, height)
        optics = read_optics(frame, *(stated or (width, height)))
        shots.append(Shot(frame.name, frame.image, frame.c2w, optics, mask, upright))
    orientation.report(source)
    return shots


def read_mask_paths(frames: list[Frame], folder: Path) -> list[Path | None]:
    """The masks that frames name, or else those found beside the photos.

    Raises:
        InputError: a named mask that is not there.
    """
    if not any(frame.entry.get("mask_path") for frame in frames):
        return find_masks([frame.image for frame in frames if frame.image is not None], folder)
    finder = ImageFinder(folder)
    masks: list[Path | None] = []
    for frame in frames:
        name, key = frame.entry.get("mask_path"), f"{frame.key}.mask_path"
        if name is None:
            masks.append(None)
            continue
        if not isinstance(name, str):
            raise InputError(frame.file, key, repr(name)[:60], "a string")
        if (mask := finder.find(name, frame.file, key)) is None:
            found, expected = f"{name!r}, which is not there", "an image, white where the photo is kept"
            raise InputError(frame.file, key, found, expected)
        masks.append(mask)
    finder.report(frames[0].file)
    return masks


def make_path(frames: list[Frame], optics: Optics) -> Cameras:
    """Pinhole cameras along the poses of frames without photos, with the intrinsics of a photo."""
    c2w = torch.from_numpy(np.stack([frame.c2w for frame in frames]))
    K = torch.from_numpy(optics.K).repeat(len(frames), 1, 1)
    return Cameras.of_size(K.float(), c2w, optics.width, optics.height)
