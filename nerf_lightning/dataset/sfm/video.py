"""The frames of a video, one after another."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require
from nerf_lightning.utils.progress import tracked

if TYPE_CHECKING:
    import av

VIDEOS = {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".3gp", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv"}
"""Files that are taken for videos."""


def decode(video: Path, words: str) -> Iterator["av.VideoFrame"]:
    """Decodes all whole frames of a video's first picture stream, with a progress bar; memory holds a few.

    Args:
        video: of any kind that FFmpeg reads.
        words: what the bar says.

    Raises:
        InputError: PyAV is not installed; no video, one without pictures, or a damaged one.
    """
    require("video", "av", purpose="the optional extra that reads videos", otherwise=", or give a folder of photos")
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
            for frame in tracked(container.decode(stream), total, words):
                if not frame.is_corrupt:  # FFmpeg paints over what is damaged
                    yield frame
    except av.FFmpegError as error:
        found = f"something unreadable ({error.strerror})"
        raise InputError(video, "", found, "a whole video", "copy it again, or save it as .mp4") from error
