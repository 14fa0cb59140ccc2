"""A video becomes a folder of photos: its sharpest frames, evenly spread over the camera's motion."""

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float, UInt8

from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.dataset.sfm.cache import build_cached_folder
from nerf_lightning.dataset.sfm.colmap import MIN_PHOTOS
from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require_extra
from nerf_lightning.utils.parsing import require_file
from nerf_lightning.utils.progress import track_progress

if TYPE_CHECKING:
    import av

log = logging.getLogger(__name__)

VIDEOS = {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".3gp", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv"}
"""Files that are taken for videos."""
MAX_FRAMES = 120
"""Taken of a video if nobody says how many: one for every three degrees of a full turn."""
MIN_STEP_FRACTION = 0.01
"""Motion between two frames that are worth taking both, as a share of the longest side; likewise."""
SHARPNESS_WINDOW = 3
"""Neighbouring frames of which the sharpest is taken."""
MIN_MOTION_PX = 0.05
"""Motion in the small pictures that noise and compression make up where nothing moves."""
SHARPNESS_SIDE, MOTION_SIDE = 960, 160
"""Longest sides in pixels of the grey pictures in which sharpness and motion are measured."""
JPEG_QUALITY = 95


def extract_frames(video: Path) -> Path:
    """The folder with a video's frames, in the cache.

    Frames that are there and were made of the same video stay as they are: whoever deletes some does not get them back.

    Raises:
        InputError: see `write_frames`.
    """
    folder = build_cached_folder(video, [require_file(video)], lambda empty: write_frames(video, empty))
    log.info("%s: %d frames are in %s", video, len(list(folder.glob("*.jpg"))), folder)
    return folder


def write_frames(video: Path, folder: Path, count: int | None = None) -> None:
    """Writes the sharpest frame of each stretch of motion as a JPEG that is named after its number in the video, upright.

    The video is decoded twice, to measure and to write, so that memory holds a few frames only.

    Args:
        video: of any kind that FFmpeg reads.
        folder: an empty one.
        count: how many at most; None: as many as its motion needs.

    Raises:
        InputError: PyAV is not installed, the video is damaged, or has too few frames.
    """
    log.info("%s: measuring blur and motion", video)
    motion, sharpness = measure_frames(video)
    if len(motion) < MIN_PHOTOS:
        found = f"{len(motion)} frame{'' if len(motion) == 1 else 's'}"
        raise InputError(video, "", found, f"at least {MIN_PHOTOS}", "film the subject from all sides")
    chosen = set(select_frames(motion, sharpness, count))
    for index, frame in enumerate(decode_frames(video, "writing the sharpest frames")):
        if index in chosen:
            upright = np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90) % 4)  # phones set a flag
            imageio.imwrite(folder / f"{index:06d}.jpg", np.ascontiguousarray(upright), quality=JPEG_QUALITY)


def decode_frames(video: Path, words: str) -> Iterator["av.VideoFrame"]:
    """Decodes all whole frames of a video's first picture stream, with a progress bar; memory holds a few.

    Args:
        video: of any kind that FFmpeg reads.
        words: what the bar says.

    Raises:
        InputError: PyAV is not installed; no video, one without pictures, or a damaged one.
    """
    require_extra("video", "av", purpose="the optional extra that reads videos", hint=", or give a folder of photos")
    import av

    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                found = ", ".join(sorted({stream.type for stream in container.streams})) or "no stream"
                raise InputError(video, "", f"only {found}", "a video with pictures")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            seconds = float(container.duration or 0) / av.time_base
            total = max(1, stream.frames or round(seconds * float(stream.average_rate or 0)))
            for frame in track_progress(container.decode(stream), total, words):
                if not frame.is_corrupt:  # FFmpeg paints over what is damaged
                    yield frame
    except av.FFmpegError as error:
        found = f"cannot be decoded ({error.strerror})"
        raise InputError(video, "", found, hint="copy it again, or save it as .mp4") from error


def measure_frames(video: Path) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """The motion that leads to each frame of a video, 0 for the first, and the sharpness of each."""
    motion, sharpness, before = [], [], None
    for frame in decode_frames(video, "measuring blur and motion"):
        size = fit_size(frame.width, frame.height, SHARPNESS_SIDE)
        picture = frame.reformat(*size, "gray", interpolation="AREA").to_ndarray()
        sharpness.append(measure_sharpness(picture))
        small = cv2.resize(picture, fit_size(*size, MOTION_SIDE), interpolation=cv2.INTER_AREA)
        motion.append(measure_motion(before, small) if before is not None and before.shape == small.shape else 0.0)
        before = small
    return np.array(motion), np.array(sharpness)


def measure_motion(before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> float:
    """How far the content of two small pictures is shifted, as a share of their longest side.

    The mean length of dense optical flow (Kroeger et al. 2016), weighted by contrast: plain areas show no motion.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(before, after, None)  # type: ignore[call-overload]
    contrast = np.hypot(*(cv2.Sobel(before, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))))
    pixels = float((np.linalg.norm(flow, axis=-1) * contrast).sum() / max(float(contrast.sum()), 1e-6))
    return max(0.0, pixels - MIN_MOTION_PX) / max(before.shape)


def measure_sharpness(picture: UInt8[np.ndarray, "H W"]) -> float:
    """Logarithm of a picture's fine detail over its coarse detail: variances of the Laplacian at two scales.

    Neither exposure nor contrast changes it, and blur takes away the fine detail first. It does depend on what a picture
    shows, so that only pictures of nearly the same can be compared.
    """
    fine, coarse = (
        float(cv2.Laplacian(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma), cv2.CV_32F).var())
        for sigma in (1.0, 3.0)  # the first takes noise away
    )
    return math.log((fine + 1e-6) / (coarse + 1e-6))


def select_frames(
    motion: Float[np.ndarray, "N"], sharpness: Float[np.ndarray, "N"], count: int | None = None
) -> list[int]:
    """Divides a video into stretches of equal motion and takes the sharpest of the frames nearest to each one's middle.

    Args:
        motion: that leads to each frame.
        sharpness: of each frame.
        count: stretches; None: as many as the motion is worth, and as there are candidates for.

    Returns:
        Indices in order; fewer than `count` where the camera moves fast.
    """
    if count is None:
        moving = 1 + int(np.count_nonzero(motion > motion.mean() / 8))
        worth = math.ceil(float(motion.sum()) / MIN_STEP_FRACTION)
        count = max(MIN_PHOTOS, min(MAX_FRAMES, moving // SHARPNESS_WINDOW, worth))
    # Frames where nothing moves count a little, so that a video of a still scene can be divided too.
    path = np.cumsum(motion + 1e-6 * max(float(motion.sum()), 1.0) / len(motion))
    chosen, end = [], 0
    for middle in np.searchsorted(path, path[-1] * (np.arange(count) + 0.5) / count).tolist():
        start = max(end, middle - SHARPNESS_WINDOW // 2)
        if start <= min(middle + SHARPNESS_WINDOW // 2, len(motion) - 1):  # else the frame before stands for it
            end = min(start + SHARPNESS_WINDOW, len(motion))
            chosen.append(max(range(start, end), key=sharpness.__getitem__))
    return chosen
