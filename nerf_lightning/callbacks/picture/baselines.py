"""Baselines: what a JPEG or a smaller picture of the same bytes looks like, to judge a 2D field by."""

import math
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import lightning as L
import numpy as np
from jaxtyping import UInt8

from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.evaluation import Evaluation
from nerf_lightning.callbacks.results import artifact_bytes
from nerf_lightning.dataset import Picture
from nerf_lightning.system import System
from nerf_lightning.utils.files import write_json

Image = UInt8[np.ndarray, "H W 3"]
QUALITIES = (*range(5, 90, 5), *range(90, 101))
"""Of the JPEGs that are tried: bytes grow fastest near 100."""
SAMPLINGS = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
"""Colours at half resolution, and at full."""


def quality_of(image: Image, truth: Image) -> float | None:
    """PSNR in dB; None if the two are equal, since JSON has no infinity."""
    return None if np.array_equal(image, truth) else round(cv2.PSNR(image, truth), 4)


def jpegs(image: Image) -> list[dict[str, Any]]:
    """Quality, size in bytes and PSNR of JPEGs of a picture."""
    found, bgr = [], np.ascontiguousarray(image[..., ::-1])
    for quality, sampling in product(QUALITIES, SAMPLINGS):
        options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
        _, coded = cv2.imencode(".jpg", bgr, options)
        decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
        assert decoded is not None  # encoded one line above
        found.append({"quality": quality, "bytes": len(coded), "psnr": quality_of(decoded, bgr)})
    return found


def decibels(one: dict[str, Any]) -> float:
    """PSNR of a JPEG, infinite where nothing is lost."""
    return math.inf if one["psnr"] is None else one["psnr"]


def shrunk(image: Image, limit: int) -> dict[str, Any]:
    """The picture shrunk to `limit` bytes at three bytes a pixel, then enlarged again by bicubic interpolation."""
    height, width = image.shape[:2]
    scale = min(1.0, (limit / image.nbytes) ** 0.5)
    small = (max(1, int(width * scale)), max(1, int(height * scale)))
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
        evaluation, scene = attached(trainer, Evaluation), data_of(trainer).scene
        if evaluation is None or not isinstance(scene, Picture) or not trainer.is_global_zero:
            return
        image, size, quality = scene.image.numpy(), artifact_bytes(pl_module), evaluation.psnr
        coded, small = jpegs(image), shrunk(image, size)
        same = max((one for one in coded if one["bytes"] <= size), key=decibels, default=None)
        as_good = [one for one in coded if quality is not None and decibels(one) >= quality]
        cheapest = min(as_good, key=lambda one: one["bytes"], default=None)
        found = {
            "bytes": size,
            "picture_bytes": image.nbytes,
            "field": quality,
            "jpeg": same,
            "bicubic": small,
            "jpeg_as_good": cheapest,
        }
        write_json(Path(trainer.default_root_dir) / "baselines.json", found)
        text = f"in {size_of(size)} (the picture's pixels have {size_of(image.nbytes)}):"
        text += f" JPEG {'none that small' if same is None else words(same['psnr'])}"
        text += f"; shrunk and enlarged by bicubic interpolation {words(small['psnr'])}"
        if cheapest is not None:
            text += f"; a JPEG as good as the field has {size_of(cheapest['bytes'])}"
        print(text)
