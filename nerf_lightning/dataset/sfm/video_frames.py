"""Extracts photos from a video: its sharpest frames, evenly spaced along the camera's motion."""

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
"""Video extensions."""
MAX_FRAMES = 120
"""Default maximum number of frames: one per three degrees of a full orbit."""
MIN_STEP_FRACTION = 0.01
"""Minimum motion between chosen frames, relative to the longest side, by default."""
SHARPNESS_WINDOW = 3
"""Neighboring frames from which the sharpest is chosen."""
MIN_MOTION_PX = 0.05
"""Apparent motion caused by noise and compression, in pixels of the small frames."""
SHARPNESS_SIDE, MOTION_SIDE = 960, 160
"""Longest sides in pixels of the gray frames for measuring sharpness and motion."""
JPEG_QUALITY = 95


def extract_frames(video: Path) -> Path:
    """Extracts a video's frames into a folder in the cache, and returns it.

    Cached frames of the same video are reused as they are: deleted ones are not restored.

    Raises:
        InputError: see `write_frames`.
    """
    folder = build_cached_folder(video, [require_file(video)], lambda empty: write_frames(video, empty))
    log.info("%s: %d frames in %s", video, len(list(folder.glob("*.jpg"))), folder)
    return folder


def write_frames(video: Path, folder: Path, count: int | None = None) -> None:
    """Writes the sharpest frame of each interval of motion as an upright JPEG named by its frame number.

    The video is decoded twice, to measure and to write, so that memory holds only a few frames.

    Args:
        video: any format of FFmpeg.
        folder: empty folder.
        count: maximum number of frames; None: chosen by the motion.

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


def decode_frames(video: Path, label: str) -> Iterator["av.VideoFrame"]:
    """Decodes all intact frames of a video's first video stream lazily, with a progress bar.

    Args:
        video: any format of FFmpeg.
        label: text of the progress bar.

    Raises:
        InputError: PyAV is not installed, or the video is damaged or has no video stream.
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
            for frame in track_progress(container.decode(stream), total, label):
                if not frame.is_corrupt:  # FFmpeg conceals damage
                    yield frame
    except av.FFmpegError as error:
        found = f"cannot be decoded ({error.strerror})"
        raise InputError(video, "", found, hint="copy it again, or save it as .mp4") from error


def measure_frames(video: Path) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Measures the motion up to each frame of a video, 0 for the first, and its sharpness."""
    motion, sharpness, last = [], [], None
    for frame in decode_frames(video, "measuring blur and motion"):
        size = fit_size(frame.width, frame.height, SHARPNESS_SIDE)
        picture = frame.reformat(*size, "gray", interpolation="AREA").to_ndarray()
        sharpness.append(measure_sharpness(picture))
        small = cv2.resize(picture, fit_size(*size, MOTION_SIDE), interpolation=cv2.INTER_AREA)
        motion.append(measure_motion(last, small) if last is not None and last.shape == small.shape else 0.0)
        last = small
    return np.array(motion), np.array(sharpness)


def measure_motion(previous: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> float:
    """Measures the motion between two small frames, relative to their longest side.

    The mean length of dense optical flow (Kroeger et al. 2016), weighted by contrast: textureless areas show no motion.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(previous, after, None)  # type: ignore[call-overload]
    contrast = np.hypot(*(cv2.Sobel(previous, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))))
    pixels = float((np.linalg.norm(flow, axis=-1) * contrast).sum() / max(float(contrast.sum()), 1e-6))
    return max(0.0, pixels - MIN_MOTION_PX) / max(previous.shape)


def measure_sharpness(picture: UInt8[np.ndarray, "H W"]) -> float:
    """Measures sharpness: log ratio of the Laplacian's variance at a fine and a coarse scale.

    Invariant to exposure and contrast; blur removes fine detail first. Comparable only between frames of similar content.
    """
    fine, coarse = (
        float(cv2.Laplacian(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma), cv2.CV_32F).var())
        for sigma in (1.0, 3.0)  # the first removes noise
    )
    return math.log((fine + 1e-6) / (coarse + 1e-6))


def select_frames(
    motion: Float[np.ndarray, "N"], sharpness: Float[np.ndarray, "N"], count: int | None = None
) -> list[int]:
    """Selects the sharpest frame near the middle of each of `count` intervals of equal motion.

    Args:
        motion: motion up to each frame.
        sharpness: sharpness of each frame.
        count: intervals; None: chosen by the motion and the number of candidates.

    Returns:
        Sorted indices; fewer than `count` where the camera moves fast.
    """
    if count is None:
        moving = 1 + int(np.count_nonzero(motion > motion.mean() / 8))
        max_steps = math.ceil(float(motion.sum()) / MIN_STEP_FRACTION)
        count = max(MIN_PHOTOS, min(MAX_FRAMES, moving // SHARPNESS_WINDOW, max_steps))
    # A small constant per frame, so that a video without motion can be divided too.
    path = np.cumsum(motion + 1e-6 * max(float(motion.sum()), 1.0) / len(motion))
    chosen, end = [], 0
    for middle in np.searchsorted(path, path[-1] * (np.arange(count) + 0.5) / count).tolist():
        start = max(end, middle - SHARPNESS_WINDOW // 2)
        if start <= min(middle + SHARPNESS_WINDOW // 2, len(motion) - 1):  # else covered by the previous interval
            end = min(start + SHARPNESS_WINDOW, len(motion))
            chosen.append(max(range(start, end), key=sharpness.__getitem__))
    return chosen
