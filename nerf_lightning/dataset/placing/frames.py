"""A video becomes a folder of photos: its sharpest frames, evenly spread over the camera's way."""

import logging
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float

from nerf_lightning.dataset.placing.choose import FEWEST, choose, motion, sharpness, suitable_count
from nerf_lightning.dataset.placing.kept import kept_folder, made_of
from nerf_lightning.dataset.placing.video import colours, frames, grey, seconds_of
from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic_folder
from nerf_lightning.utils.parsing import existing_file

log = logging.getLogger(__name__)

MEASURED, SMALL = 960, 160
"""Longest sides in pixels of the grey pictures in which blur and motion are measured."""
QUALITY = 95
"""Of JPEG, out of 100."""


def kept_frames(video: Path) -> Path:
    """The folder with a video's frames: `NAME_frames` beside the video, or in the cache where that cannot be written.

    Frames that are there and were made of the same video stay as they are: whoever deletes some does not get them back.

    Raises:
        InputError: see `frames_of`; or a folder of somebody else has that name.
    """
    beside = video.with_name(f"{video.stem}_frames")
    sources = made_of([existing_file(video)])
    folder = kept_folder(
        beside, sources, lambda kept: any(kept.glob("*.jpg")), lambda empty: _write(video, empty, None)
    )
    log.info("%s: the %d sharpest frames are in %s", video, len(list(folder.glob("*.jpg"))), folder)
    return folder


def frames_of(video: Path, folder: Path, count: int | None = None) -> list[Path]:
    """Writes the sharpest frame of each stretch of motion as a JPEG that is named after its time in seconds, upright.

    The video is decoded twice, to measure and to write, so that memory holds a few frames only.

    Args:
        video: of any kind that FFmpeg reads.
        folder: for the frames alone: written whole, in place of whatever is there, or not at all.
        count: how many, at most as many as the video has; None: as many as its motion needs, see `suitable_count`.

    Raises:
        InputError: PyAV is not installed, the video is damaged, or has too few frames.
    """
    with atomic_folder(folder) as temporary:
        _write(video, temporary, count)
    return sorted(folder.iterdir())


def measure(video: Path) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """The motion that leads to each frame of a video, 0 for the first, and the sharpness of each; see `choose`."""
    motions, sharp, before = [], [], None
    for frame in frames(video, "measuring blur and motion"):
        picture = grey(frame, MEASURED)
        sharp.append(sharpness(picture))
        height, width = picture.shape
        small = cv2.resize(picture, fit_size(width, height, SMALL), interpolation=cv2.INTER_AREA)
        motions.append(motion(before, small) if before is not None and before.shape == small.shape else 0.0)
        before = small
    return np.array(motions), np.array(sharp)


def _write(video: Path, folder: Path, count: int | None) -> None:
    log.info("%s: measuring blur and motion", video)
    motions, sharp = measure(video)
    if len(motions) < FEWEST:
        found = f"{len(motions)} frame{'' if len(motions) == 1 else 's'}"
        raise InputError(video, "", found, f"at least {FEWEST}", "film the subject from all sides")
    count = suitable_count(motions) if count is None else min(count, len(motions))
    chosen = set(choose(motions, sharp, count))
    for index, frame in enumerate(frames(video, "writing the sharpest frames")):
        if index in chosen:
            # Whole seconds with leading zeros: names stand in the order of time.
            name = f"{seconds_of(frame, index):08.3f}s.jpg"
            name = f"{index:06d}_{name}" if (folder / name).exists() else name
            imageio.imwrite(folder / name, colours(frame), quality=QUALITY)
