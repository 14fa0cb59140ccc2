"""Baselines: what a JPEG or a smaller picture of the same bytes looks like, to judge a 2D field by."""

import math
from bisect import bisect_left, bisect_right
from pathlib import Path
from typing import Any

import cv2
import lightning as L
import numpy as np
from jaxtyping import UInt8

from nerf_lightning.callbacks.attached import attached, picture_of
from nerf_lightning.callbacks.results import Results
from nerf_lightning.system import System
from nerf_lightning.utils.files import write_json

Image = UInt8[np.ndarray, "H W 3"]


def quality_of(image: Image, truth: Image) -> float | None:
    """PSNR in dB; None if the two are equal, since JSON has no infinity."""
    if np.array_equal(image, truth):
        return None
    return round(cv2.PSNR(image, truth), 4)


def jpeg(image: Image, quality: int, sampling: int) -> tuple[int, Image]:
    """Size of the file in bytes, and the decoded picture."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    _, coded = cv2.imencode(".jpg", image[..., ::-1], options)
    decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    assert decoded is not None  # encoded one line above
    return len(coded), np.ascontiguousarray(decoded[..., ::-1])


SAMPLINGS = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
QUALITIES = range(1, 101)
"""A file grows with it, and so does what is kept: the one that is looked for is found by halving."""


def described(image: Image, quality: int, sampling: int) -> dict[str, Any]:
    """A JPEG's quality, size in bytes, and PSNR."""
    size, decoded = jpeg(image, quality, sampling)
    return {"quality": quality, "bytes": size, "psnr": quality_of(decoded, image)}


def best_jpeg(image: Image, limit: int) -> dict[str, Any] | None:
    """The best JPEG of at most `limit` bytes, with or without colours at half resolution; None if none is that small."""
    found: list[dict[str, Any]] = []
    for sampling in SAMPLINGS:
        fitting = bisect_right(QUALITIES, limit, key=lambda quality: jpeg(image, quality, sampling)[0])
        if fitting:
            found.append(described(image, QUALITIES[fitting - 1], sampling))
    return max(found, key=decibels, default=None)


def jpeg_as_good(image: Image, wanted: float) -> dict[str, Any] | None:
    """The smallest JPEG of at least `wanted` dB; None if even the best is worse."""
    found: list[dict[str, Any]] = []
    for sampling in SAMPLINGS:
        worse = bisect_left(QUALITIES, wanted, key=lambda quality: decibels(described(image, quality, sampling)))
        if worse < len(QUALITIES):
            found.append(described(image, QUALITIES[worse], sampling))
    return min(found, key=lambda one: one["bytes"], default=None)


def decibels(one: dict[str, Any]) -> float:
    """PSNR of a JPEG, infinite where nothing is lost."""
    return math.inf if one["psnr"] is None else one["psnr"]


def shrunk(image: Image, limit: int) -> dict[str, Any]:
    """The picture shrunk to `limit` bytes at three bytes a pixel, then enlarged again by bicubic interpolation."""
    height, width = image.shape[:2]
    scale = min(1.0, (limit / image.nbytes) ** 0.5)
    down = max(1, int(height * scale))
    across = max(1, min(int(width * scale), limit // (3 * down)))
    small = (across, max(1, min(down, limit // (3 * across))))
    less = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
    back = cv2.resize(less, (width, height), interpolation=cv2.INTER_CUBIC)
    return {"width": small[0], "height": small[1], "bytes": less.nbytes, "psnr": quality_of(back, image)}


def size_of(count: int) -> str:
    """Bytes in words."""
    return f"{count / 1e6:.2f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def words(psnr_db: float | None) -> str:
    return "without loss" if psnr_db is None else f"{psnr_db:.2f} dB"


class Baselines(L.Callback):
    """After the test, compares the field with a JPEG and with a shrunk picture of the same bytes: prints, baselines.json."""

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        results = attached(trainer, Results)
        if results is None or not trainer.is_global_zero:
            return
        size, quality = results.summary["artifact_bytes"], results.summary["psnr"]
        image = picture_of(trainer).image.numpy()
        same, small = best_jpeg(image, size), shrunk(image, size)
        found = {
            "bytes": size,
            "picture_bytes": image.nbytes,
            "field": quality,
            "jpeg": same,
            "bicubic": small,
            "jpeg_as_good": None if quality is None else jpeg_as_good(image, quality),
        }
        write_json(Path(trainer.default_root_dir) / "baselines.json", found)
        coded = "none that small" if same is None else words(same["psnr"])
        told = f"in {size_of(size)} (the picture's pixels have {size_of(image.nbytes)}): JPEG {coded}"
        told += f"; shrunk and enlarged by bicubic interpolation {words(small['psnr'])}"
        if found["jpeg_as_good"] is not None:
            told += f"; a JPEG as good as the field has {size_of(found['jpeg_as_good']['bytes'])}"
        print(told)
