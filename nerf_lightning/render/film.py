"""Films: frames are kept on disk until the film is written, so that an interrupted one can go on."""

import shutil
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from nerf_lightning.dataset.formats.decode import image_header
from nerf_lightning.drawing.panels import write_animation
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic, write_json
from nerf_lightning.utils.libraries import require
from nerf_lightning.utils.parsing import read_json
from nerf_lightning.utils.progress import tracked

Picture = UInt8[ndarray, "H W C"]
PLAN = "frames.json"
"""Beside the frames: what they show, so that frames of something else are never reused."""
FILMS = (".gif", ".mp4", ".webp")
KEPT = {".gif": 1, ".webp": 4}
"""Bytes of each pixel that formats keep in memory while frames are joined."""
OPAQUE = (".gif", ".mp4")
"""Formats without partial transparency."""
CRF = 18
"""Of H.264: smaller is better, 18 looks like the original."""


def check_output(output: Path, transparent: bool) -> None:
    """Raises InputError where no film can be written to a place, before any work is done."""
    if output.suffix not in ("", *FILMS):
        raise InputError("config", "output", output.name, f"a name ending in {', '.join(FILMS)}, or a folder for PNGs")
    if output.suffix and output.is_dir():
        raise InputError(output, "", "a folder", "a file to write", "give output another name")
    if not output.suffix and output.exists() and not output.is_dir():
        raise InputError(output, "", "a file", "a folder for PNGs", "give output another name")
    if transparent and output.suffix in OPAQUE:
        raise InputError("config", "background", f"transparent for {output.suffix}", "a colour", "or output=FILE.webp")
    if output.suffix == ".mp4":
        purpose = "the optional extra that writes .mp4"
        require("video", "av", purpose=purpose, otherwise=", or output=FILE.webp")


def make_film(plan: dict[str, Any], draw: Callable[[int], Picture], count: int, output: Path, fps: float) -> int:
    """Draws all frames that are not there yet, and joins them.

    Frames stand in the folder itself, or beside a film in a folder of its own until it is written.

    Args:
        plan: all that the frames depend on, as plain values.
        draw: makes a frame.
        count: how many.
        output: a folder, or a file whose suffix says what kind of film.
        fps: frames a second.

    Returns:
        How many frames were there already.

    Raises:
        InputError: where the folder holds something else.
    """
    folder = output.with_name(f"{output.name}.frames") if output.suffix else output
    files = [folder / f"{index:05d}.png" for index in range(count)]
    prepare(folder, plan, own=bool(output.suffix))
    left = [index for index in range(count) if not files[index].exists()]
    for index in tracked(left, len(left), "frames"):
        picture = draw(index)
        if index == left[0]:  # nothing is left of a film of which not even a frame can be drawn
            write_json(folder / PLAN, plan)
        with atomic(files[index]) as temporary:
            imageio.imwrite(temporary, picture, compress_level=1)
    if output.suffix:
        with atomic(output) as temporary:
            join(files, temporary, fps)
        shutil.rmtree(folder)
    return count - len(left)


def prepare(folder: Path, plan: dict[str, Any], own: bool) -> None:
    """Makes way for the frames of a plan: those of another plan are deleted if the folder is our own.

    Raises:
        InputError: where the folder is not, and holds something else.
    """
    try:
        found = read_json(folder / PLAN, "a plan of frames")
    except InputError:  # none there, or none whole
        found = None
    if found != plan and folder.exists():
        if own:
            shutil.rmtree(folder)
        elif any(folder.iterdir()):
            raise InputError(folder, "", "something else in it", "a folder for these frames alone", "give output=DIR")


def framed(files: list[Path]) -> Iterator[UInt8[ndarray, "H W C"]]:
    """Frames on disk, those of smaller photos in the middle of a black or transparent frame of the size of the largest."""
    sizes = [image_header(file)[:2] for file in files]
    width, height = (max(sides) for sides in zip(*sizes, strict=True))
    for file, (w, h) in zip(files, sizes, strict=True):
        left, top = (width - w) // 2, (height - h) // 2
        yield np.pad(imageio.imread(file), ((top, height - h - top), (left, width - w - left), (0, 0)))


def join(files: list[Path], output: Path, fps: float) -> None:
    """Frames on disk -> one film, of the kind that its suffix says."""
    if output.suffix == ".mp4":
        join_mp4(files, output, fps)
        return
    write_animation(output, framed(files), 1 / fps)


def join_mp4(files: list[Path], output: Path, fps: float) -> None:
    """H.264 with colours at half resolution, which every player knows; odd sizes get one more row or column, never a resize."""
    import av

    with av.open(str(output), "w", options={"movflags": "faststart"}) as container:
        stream: Any = container.add_stream(
            "libx264", rate=Fraction(fps).limit_denominator(1000), options={"crf": str(CRF)}
        )
        for index, frame in enumerate(framed(files)):
            picture = even(frame)
            if not index:
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


def even(picture: UInt8[ndarray, "H W 3"]) -> UInt8[ndarray, "H2 W2 3"]:
    """A picture with its last row and column repeated where their number is odd."""
    height, width, _ = picture.shape
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
