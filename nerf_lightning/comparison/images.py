"""What each configuration shows of one held-out view, beside the truth, with a magnified crop."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from jaxtyping import UInt8

from nerf_lightning.comparison.points import typical_run
from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.drawing.contact_sheet import fit_into
from nerf_lightning.drawing.ink import VERMILLION, rgb
from nerf_lightning.errors import InputError

MAX_IMAGES = 11
LONGEST_PX = 480
GAP = ((0, 4), (0, 0), (0, 0))
"""White between an image and its crop."""
CROP = 4
"""How many times shorter than the image's sides the crop's are."""


def collect_images(points: pd.DataFrame) -> list[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
    """Captions and images, the truth first: each whole and, below, its crop where the images differ most, magnified.

    Args:
        points: of `compute_points`, the best first; those without an image are left out.
    """
    found: list[tuple[str, UInt8[np.ndarray, "H W 3"]]] = []
    for point in points.head(MAX_IMAGES).itertuples():
        run = typical_run(point)
        truth, image = read_image(run.folder / "truth.png"), read_image(run.folder / "final.png")
        found += [("truth", truth)] if truth is not None and not found else []
        found += [(f"{point.label}\n{run.psnr:.2f} dB", image)] if image is not None else []
    if not found:
        return []
    height, width = found[0][1].shape[:2]
    images = [cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for _, image in found]
    top, left = find_differences(images)
    rows, cols = max(1, height // CROP), max(1, width // CROP)
    shown = []
    for (caption, _), image in zip(found, images, strict=True):
        whole, crop = (
            np.ascontiguousarray(fit_into(part, LONGEST_PX, LONGEST_PX))
            for part in (image, image[top : top + rows, left : left + cols])
        )
        scale = whole.shape[1] / width
        box = [round(scale * x) for x in (left, top, cols, rows)]
        cv2.rectangle(whole, box, rgb(VERMILLION), 2)
        shown.append(
            (caption, np.concatenate([np.pad(whole, GAP, constant_values=255), cv2.resize(crop, whole.shape[1::-1])]))
        )
    return shown


def find_differences(images: list[UInt8[np.ndarray, "H W 3"]]) -> tuple[int, int]:
    """Row and column where the crop begins in which images of one size vary most."""
    height, width = images[0].shape[:2]
    rows, cols = max(1, height // CROP), max(1, width // CROP)
    spread = np.stack(images).std(axis=0, dtype=np.float32).mean(-1)
    means = cv2.boxFilter(spread, -1, (cols, rows), anchor=(0, 0))[: height - rows + 1, : width - cols + 1]
    top, left = np.unravel_index(means.argmax(), means.shape)
    return int(top), int(left)


def read_image(file: Path) -> UInt8[np.ndarray, "H W 3"] | None:
    """None where there is none, or none that can be read."""
    try:
        return np.ascontiguousarray(read_pixels(file)[..., :3])
    except InputError:
        return None
