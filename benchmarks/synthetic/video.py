"""Videos along a known path around the tabletop, with some frames blurred."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from benchmarks.synthetic.tabletop import Tabletop
from nerf_lightning.cameras import look_at
from nerf_lightning.capture.tags.tag_layout import TagLayout
from nerf_lightning.dataset.intrinsics import Intrinsics

CRF = 20
"""Constant rate factor of H.264, about that of phones."""
FPS = 30


def place_cameras(layout: TagLayout, lens: Intrinsics, count: int) -> Float[np.ndarray, "count 4 4"]:
    """Camera-to-world poses of a smooth turn around the bulldozer, with varying height and distance."""
    top = Tabletop(layout)
    center = top.box.mean(0)
    radius = float(np.linalg.norm(top.box[1] - top.box[0])) / 2
    turns = 2 * np.pi * np.arange(count) / count
    elevation = np.radians(42 + 14 * np.sin(2 * turns))
    distance = radius * 2.4 * lens.fx / lens.height * (1 + 0.12 * np.cos(3 * turns))
    ring = np.cos(elevation)
    eye = center + distance[:, None] * np.stack([ring * np.cos(turns), ring * np.sin(turns), np.sin(elevation)], -1)
    up = torch.tensor([0.0, 0.0, 1.0]).double()
    return look_at(torch.from_numpy(eye), torch.from_numpy(center), up).numpy()


def blur_image(
    picture: UInt8[np.ndarray, "H W 3"], pixels: float, angle: float | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Blurs an image by a Gaussian of a standard deviation in pixels, or along a line of that length and angle (radians)."""
    if angle is None:
        return cv2.GaussianBlur(picture, (0, 0), pixels)
    half = int(np.ceil(pixels / 2)) + 1
    steps = np.linspace(-pixels / 2, pixels / 2, 64)
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    x, y = half + steps * np.cos(angle), half + steps * np.sin(angle)
    for dx in (0, 1):
        for dy in (0, 1):
            col, row = np.floor(x).astype(int) + dx, np.floor(y).astype(int) + dy
            np.add.at(kernel, (row, col), (1 - np.abs(x - col)) * (1 - np.abs(y - row)))
    return cv2.filter2D(picture, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)


BLURS = ((0.5, False), (0.7, False), (1.0, False), (2.0, False), (1.5, True), (2.5, True), (4.0, True), (8.0, True))
"""Pixels, and whether along a line; the weakest are hardly visible."""


def blur_images(
    pictures: Iterable[UInt8[np.ndarray, "H W 3"]], seed: int, every: int = 3
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Blurs every `every`-th image, from the second on, by each of `BLURS` in turn, along random lines."""
    rng = np.random.default_rng(seed)
    for index, picture in enumerate(pictures):
        pixels, line = BLURS[index // every % len(BLURS)]
        angle = float(rng.uniform(0, np.pi)) if line else None
        yield blur_image(picture, pixels, angle) if index % every == 1 else picture


def write_video(file: Path, pictures: Iterable[UInt8[np.ndarray, "H W 3"]], quarter_turns: int = 0) -> None:
    """Writes an H.264 video as phones do.

    Args:
        file: .mp4 or .mov to write.
        pictures: of even height and width.
        quarter_turns: counter-clockwise rotation flag, as in portrait videos of phones.
    """
    with av.open(str(file), "w") as container:
        stream: Any = container.add_stream("libx264", rate=FPS, options={"crf": str(CRF)})
        for index, picture in enumerate(pictures):
            if not index:
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    if quarter_turns:
        _write_rotation(file, quarter_turns)


def _write_rotation(file: Path, quarter_turns: int) -> None:
    """Writes the rotation into the track header, for which there is no option: a matrix of 16.16 numbers (ISO 14496-12)."""
    data = bytearray(file.read_bytes())
    start = data.index(b"tkhd") + 4 + 40
    c, s = round(np.cos(np.pi / 2 * quarter_turns)), round(np.sin(np.pi / 2 * quarter_turns))
    # Rows (a, b, u), (c, d, v), in a frame whose y points down.
    for offset, value in ((0, c), (4, -s), (12, s), (16, c)):
        data[start + offset : start + offset + 4] = (value * 65536).to_bytes(4, "big", signed=True)
    file.write_bytes(data)
