"""Video writing, resumable: frames are kept on disk until the video is complete."""

import shutil
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from nerf_lightning.dataset.formats.image_files import read_image_size
from nerf_lightning.drawing.panels import write_animation
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic_write, write_json
from nerf_lightning.utils.libraries import require_extra
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.parsing import read_json
from nerf_lightning.utils.progress import track_progress

Image = UInt8[ndarray, "H W C"]
MANIFEST_FILE = "frames.json"
"""Stored with the frames; identifies their inputs, so that other frames are never reused."""
SUFFIXES = (".gif", ".mp4", ".webp")
OPAQUE_SUFFIXES = (".gif", ".mp4")
"""Formats without an alpha channel."""
CRF = 18
"""H.264 quality: lower is better, 18 is visually lossless."""


def check_output(output: Path, transparent: bool) -> None:
    """Checks suffix, transparency and encoder of an output; raises InputError before any work is done."""
    if output.suffix not in ("", *SUFFIXES):
        expected = f"a name ending in {', '.join(SUFFIXES)}, or a folder of PNGs"
        raise InputError("render", "output", output.name, expected)
    if transparent and output.suffix in OPAQUE_SUFFIXES:
        raise InputError("render", "background", f"transparent for {output.suffix}", "a color", "or -o FILE.webp")
    if output.suffix == ".mp4":
        require_extra("video", "av", purpose="the optional extra that writes .mp4", hint=", or -o FILE.webp")


def write_video(manifest: dict[str, Any], draw: Callable[[int], Image], count: int, output: Path, fps: float) -> int:
    """Draws missing frames and encodes the video; returns the number of frames reused.

    Frames are in the output folder, or in FILE.frames until the video is complete.

    Args:
        manifest: see `build_manifest`.
        draw: draws the frame of an index.
        count: number of frames.
        output: a folder, or a file whose suffix selects the format.
        fps: frames per second.

    Raises:
        InputError: the folder holds something else.
    """
    folder = output.with_name(f"{output.name}.frames") if output.suffix else output
    files = [folder / f"{index:05d}.png" for index in range(count)]
    prepare_folder(folder, manifest, is_owned=bool(output.suffix))
    missing = [index for index in range(count) if not files[index].exists()]
    for index in track_progress(missing, len(missing), "frames"):
        image = draw(index)
        if index == missing[0]:  # write nothing if the first frame fails
            if output.suffix == ".webp":  # the writer keeps all frames in memory
                needed = 4 * count * image[..., 0].size
                check_memory("render", "frames", f"{count:,} frames", needed, "give less, or -o FILE.mp4")
            write_json(folder / MANIFEST_FILE, manifest)
        with atomic_write(files[index]) as temporary:
            imageio.imwrite(temporary, image, compress_level=1)
    if output.suffix:
        with atomic_write(output) as temporary:
            encode_video(files, temporary, fps)
        shutil.rmtree(folder)
    return count - len(missing)


def prepare_folder(folder: Path, manifest: dict[str, Any], is_owned: bool) -> None:
    """Removes frames of another manifest if the folder `is_owned`.

    Raises:
        InputError: the folder is not owned, and holds something else.
    """
    try:
        stored = read_json(folder / MANIFEST_FILE, "a plan of frames")
    except InputError:  # missing or damaged
        stored = None
    if stored != manifest and folder.exists():
        if is_owned:
            shutil.rmtree(folder)
        elif any(folder.iterdir()):
            raise InputError(folder, "", "holds other files", hint="give -o FOLDER")


def read_frames(files: list[Path]) -> Iterator[Image]:
    """Yields frames from disk, padded with black or transparent borders to the largest size."""
    sizes = [read_image_size(file)[:2] for file in files]
    width, height = (max(sides) for sides in zip(*sizes, strict=True))
    for file, (w, h) in zip(files, sizes, strict=True):
        left, top = (width - w) // 2, (height - h) // 2
        yield np.pad(imageio.imread(file), ((top, height - h - top), (left, width - w - left), (0, 0)))


def encode_video(files: list[Path], output: Path, fps: float) -> None:
    """Encodes frames on disk as a video; the suffix selects the format.

    H.264 uses yuv420p, which all players support; odd sizes are padded by a row or column.
    """
    if output.suffix != ".mp4":
        write_animation(output, read_frames(files), 1 / fps)
        return
    import av

    with av.open(str(output), "w", options={"movflags": "faststart"}) as container:
        rate = Fraction(fps).limit_denominator(1000)
        stream: Any = container.add_stream("libx264", rate=rate, options={"crf": str(CRF)})
        for index, frame in enumerate(read_frames(files)):
            height, width, _ = frame.shape
            image = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if not index:
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
