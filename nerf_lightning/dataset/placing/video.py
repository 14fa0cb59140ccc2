"""The pictures of a video, one after another, upright."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require
from nerf_lightning.utils.parsing import existing_file
from nerf_lightning.utils.progress import tracked

if TYPE_CHECKING:
    import av

VIDEOS = {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".3gp", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv"}
"""Files that are taken for videos."""


def frames(video: Path, words: str) -> Iterator["av.VideoFrame"]:
    """Decodes all whole pictures of a video's first picture stream, with a progress bar; memory holds a few.

    Args:
        video: of any kind that FFmpeg reads.
        words: what the bar says.

    Raises:
        InputError: PyAV is not installed; no video, one without pictures, or a damaged one.
    """
    require("video", "av", purpose="the optional extra that reads videos", otherwise=", or give a folder of photos")
    existing_file(video)
    import av

    with _told(video), av.open(str(video)) as container:
        if not container.streams.video:
            found = ", ".join(sorted({stream.type for stream in container.streams})) or "no stream"
            raise InputError(video, "", f"only {found}", "a video with pictures")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or 0)
        seconds = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else 0.0
        seconds = seconds or float(container.duration or 0) / av.time_base
        total = max(1, stream.frames or round(seconds * rate))
        for frame in tracked(container.decode(stream), total, words):
            if not frame.is_corrupt:  # FFmpeg paints over what is damaged
                yield frame


@contextmanager
def _told(video: Path) -> Iterator[None]:
    import av

    try:
        yield
    except av.FFmpegError as error:
        found = f"something unreadable ({error.strerror})"
        raise InputError(video, "", found, "a whole video", "copy it again, or save it as .mp4") from error


def seconds_of(frame: "av.VideoFrame", index: int) -> float:
    """When a picture is shown; a video without times counts as one of 30 pictures a second."""
    return index / 30 if frame.time is None else float(frame.time)


def quarter_turns(frame: "av.VideoFrame") -> int:
    """Counter-clockwise turns of 90 degrees that make a picture upright: phones turn the pictures by a flag alone."""
    return round(frame.rotation / 90) % 4


def grey(frame: "av.VideoFrame", longest: int) -> UInt8[np.ndarray, "H W"]:
    """A picture's brightness, as stored, with a longest side of at most `longest` pixels."""
    scale = min(1.0, longest / max(frame.width, frame.height))
    width, height = (max(1, round(side * scale)) for side in (frame.width, frame.height))
    return frame.reformat(width, height, "gray", interpolation="AREA").to_ndarray()


def colours(frame: "av.VideoFrame") -> UInt8[np.ndarray, "H W 3"]:
    """A picture in sRGB, upright."""
    return np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), quarter_turns(frame)))
