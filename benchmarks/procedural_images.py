"""Procedural images, drawn from a seed, each with one difficulty for 2D fields."""

from collections.abc import Callable
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float, UInt8

DrawnImage = UInt8[np.ndarray, "H W C"]
Generator = np.random.Generator
SUBPIXEL_BITS = 4
"""Fractional bits of OpenCV's drawing coordinates."""


def make_colored_noise(size: int, slope: float, generator: Generator) -> Float[np.ndarray, "H W 3"]:
    """Colored noise of variance 1, with amplitude proportional to frequency^-slope."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = np.inf  # no mean
    waves = np.fft.fft2(generator.standard_normal((3, size, size))) / frequency**slope
    noise = np.moveaxis(np.real(np.fft.ifft2(waves)), 0, -1)
    return noise / noise.std((0, 1))


def to_uint8(values: np.ndarray) -> DrawnImage:
    """Rounds values in [0, 255] to bytes."""
    return np.rint(values).clip(0, 255).astype(np.uint8)


def text(size: int, generator: Generator) -> DrawnImage:
    canvas = np.full((size, size, 3), 255, np.uint8)
    letters = list("abcdefghij klmnop qrstuvwxyz ABCDEF 0123456789")
    for baseline in range(14, size, 15):
        line = "".join(generator.choice(letters, size // 7))
        cv2.putText(canvas, line, (4, baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return canvas


def clouds(size: int, generator: Generator) -> DrawnImage:
    return to_uint8(127 + 50 * make_colored_noise(size, 1.6, generator))


def leaves(size: int, generator: Generator) -> DrawnImage:
    """Dead leaves: overlapping discs, many small and few large, with the statistics of photos and sharp edges."""
    canvas = np.zeros((size, size, 3), np.uint8)
    for _ in range(9000):
        x, y = (int(coordinate) for coordinate in generator.uniform(0, size, 2) * 2**SUBPIXEL_BITS)
        radius = int(size / 128 / generator.uniform(0.02, 1) * 2**SUBPIXEL_BITS)
        color = tuple(int(value) for value in generator.integers(20, 235, 3))
        cv2.circle(canvas, (x, y), radius, color, -1, cv2.LINE_AA, SUBPIXEL_BITS)
    return canvas


def zone_plate(size: int, generator: Generator) -> DrawnImage:
    """Concentric rings whose frequency rises to that of the pixels at the sides."""
    row, column = np.mgrid[:size, :size] / size - generator.uniform(0.45, 0.55)
    return to_uint8(np.repeat((127 + 120 * np.cos(0.9 * np.pi * size * (row**2 + column**2)))[..., None], 3, axis=-1))


def cut_out(size: int, generator: Generator) -> DrawnImage:
    """Leaves with a soft alpha mask."""
    row, column = np.mgrid[:size, :size] / (size - 1) - 0.5
    alpha = 255 / (1 + np.exp((np.hypot(row, column) - 0.35) * size / 4))
    return np.concatenate([leaves(size, generator), to_uint8(alpha[..., None])], axis=-1)


KINDS: dict[str, Callable[[int, Generator], DrawnImage]] = {
    draw.__name__: draw for draw in (text, clouds, leaves, zone_plate, cut_out)
}


def write_picture(kind: str, size: int, seed: int, folder: Path) -> Path:
    """Draws a square image, writes it as PNG and returns its path."""
    path = folder / f"{kind}_{size}.png"
    folder.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(path, KINDS[kind](size, np.random.default_rng(seed)))
    return path
