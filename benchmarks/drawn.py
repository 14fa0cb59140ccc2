"""Pictures of different kinds, drawn from a seed: what is hard for a field of two coordinates, each in a picture of its own."""

from collections.abc import Callable
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float, UInt8

Drawn = UInt8[np.ndarray, "H W C"]
Generator = np.random.Generator
SUBPIXEL = 4
"""Binary places of the coordinates that OpenCV draws at."""


def noise(size: int, slope: float, generator: Generator) -> Float[np.ndarray, "H W 3"]:
    """Coloured noise of variance 1, whose amplitude falls with frequency to the power of `-slope`."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = np.inf  # no mean
    waves = np.fft.fft2(generator.standard_normal((3, size, size))) / frequency**slope
    found = np.moveaxis(np.real(np.fft.ifft2(waves)), 0, -1)
    return found / found.std((0, 1))


def bytes_of(values: np.ndarray) -> Drawn:
    """Values of 0 to 255, rounded."""
    return np.rint(values).clip(0, 255).astype(np.uint8)


def strokes(canvas: Drawn, paths: list[np.ndarray], colours: list[tuple[int, ...]], width: int) -> None:
    """Draws smooth lines through points [K, 2]."""
    for path, colour in zip(paths, colours, strict=True):
        points = np.rint(path * 2**SUBPIXEL).astype(np.int32)
        cv2.polylines(canvas, [points], False, colour, width, cv2.LINE_AA, SUBPIXEL)


def walks(starts: np.ndarray, angles: np.ndarray, turns: np.ndarray, stride: float) -> list[np.ndarray]:
    """Paths of K steps from N starts [N, 2], with angles [N] at first and turns [N, K] on the way."""
    heading = angles[:, None] + np.cumsum(turns, axis=1)
    moves = stride * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return list(starts[:, None] + np.cumsum(moves, axis=1))


def text(size: int, generator: Generator) -> Drawn:
    canvas = np.full((size, size, 3), 255, np.uint8)
    letters = list("abcdefghij klmnop qrstuvwxyz ABCDEF 0123456789")
    for baseline in range(14, size, 15):
        line = "".join(generator.choice(letters, size // 7))
        cv2.putText(canvas, line, (4, baseline), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return canvas


def line_art(size: int, generator: Generator) -> Drawn:
    canvas = np.full((size, size, 3), 250, np.uint8)
    count = 160
    paths = walks(
        generator.uniform(0, size, (count, 2)),
        generator.uniform(0, 2 * np.pi, count),
        generator.normal(0, 0.25, (count, 60)),
        size / 128,
    )
    strokes(canvas, paths, [(20, 20, 30)] * count, 1)
    return canvas


def fur(size: int, generator: Generator) -> Drawn:
    canvas = np.full((size, size, 3), 60, np.uint8)
    count = size * size // 10
    starts = generator.uniform(0, size - 1, (count, 2))
    flow = noise(size, 1.8, generator)[..., 0]
    column, row = starts.astype(int).T
    paths = walks(
        starts, 1.2 * flow[row, column] + generator.normal(1.2, 0.25, count), generator.normal(0, 0.1, (count, 12)), 1.8
    )
    light = generator.uniform(0.4, 1.1, (count, 1))
    strokes(canvas, paths, [tuple(map(int, hair)) for hair in light * [190, 140, 90]], 1)
    return canvas


def clouds(size: int, generator: Generator) -> Drawn:
    return bytes_of(127 + 50 * noise(size, 1.6, generator))


def pink_noise(size: int, generator: Generator) -> Drawn:
    return bytes_of(127 + 40 * noise(size, 1.0, generator))


def grain(size: int, generator: Generator) -> Drawn:
    """A soft picture with the grain of film: the same in all colours."""
    return bytes_of(127 + 45 * noise(size, 2.2, generator) + generator.normal(0, 9, (size, size, 1)))


def leaves(size: int, generator: Generator) -> Drawn:
    """Discs on discs, many small and few large: the statistics of photos, with sharp edges."""
    canvas = np.zeros((size, size, 3), np.uint8)
    for _ in range(9000):
        x, y = (int(place) for place in generator.uniform(0, size, 2) * 2**SUBPIXEL)
        radius = int(size / 128 / generator.uniform(0.02, 1) * 2**SUBPIXEL)
        colour = tuple(int(value) for value in generator.integers(20, 235, 3))
        cv2.circle(canvas, (x, y), radius, colour, -1, cv2.LINE_AA, SUBPIXEL)
    return canvas


def screenshot(size: int, generator: Generator) -> Drawn:
    canvas = np.full((size, size, 3), 240, np.uint8)
    for number in range(60):
        left, top = (int(place) for place in generator.integers(0, size, 2))
        width, height = (int(side) for side in generator.integers(10, 160, 2))
        colour = tuple(int(value) for value in generator.integers(0, 255, 3))
        cv2.rectangle(canvas, (left, top), (left + width, top + height), colour, -1)
        place = (left + 4, top + 14)
        cv2.putText(canvas, f"Button {number}", place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return canvas


def stars(size: int, generator: Generator) -> Drawn:
    canvas = np.zeros((size, size, 3))
    count = size * size // 100
    row, column = generator.integers(0, size, (2, count))
    np.add.at(
        canvas, (row, column), 255 * generator.uniform(0, 1, (count, 1)) ** 4 * generator.uniform(0.6, 1, (count, 3))
    )
    return bytes_of(8 + 6 * cv2.GaussianBlur(canvas, (0, 0), 0.8))


def halftone(size: int, generator: Generator) -> Drawn:
    """A soft picture in dots of one ink, as newspapers print it."""
    row, column = np.mgrid[:size, :size]
    screen = np.cos(0.9 * column + 0.35 * row) + np.cos(0.9 * row - 0.35 * column)
    soft = noise(size, 2.0, generator).mean(-1)
    ink = 255 / (1 + np.exp(-4 * screen - 6 * soft))
    return bytes_of(np.repeat(ink[..., None], 3, axis=-1))


def zone_plate(size: int, generator: Generator) -> Drawn:
    """Rings that become as fine as the pixels toward the sides."""
    row, column = np.mgrid[:size, :size] / size - generator.uniform(0.45, 0.55)
    return bytes_of(np.repeat((127 + 120 * np.cos(0.9 * np.pi * size * (row**2 + column**2)))[..., None], 3, axis=-1))


def grey(size: int, generator: Generator) -> Drawn:
    """One channel: leaves without colours."""
    return cv2.cvtColor(leaves(size, generator), cv2.COLOR_RGB2GRAY)[..., None]


def cut_out(size: int, generator: Generator) -> Drawn:
    """Four channels: leaves whose outline is soft."""
    row, column = np.mgrid[:size, :size] / (size - 1) - 0.5
    alpha = 255 / (1 + np.exp((np.hypot(row, column) - 0.35) * size / 4))
    return np.concatenate([leaves(size, generator), bytes_of(alpha[..., None])], axis=-1)


KINDS: dict[str, Callable[[int, Generator], Drawn]] = {
    draw.__name__: draw
    for draw in (
        text,
        line_art,
        fur,
        clouds,
        pink_noise,
        grain,
        leaves,
        screenshot,
        stars,
        halftone,
        zone_plate,
        grey,
        cut_out,
    )
}
"""By name."""


def write_picture(kind: str, size: int, seed: int, folder: Path) -> Path:
    """Draws a square picture into a folder, as PNG, and returns its path."""
    path = folder / f"{kind}_{size}.png"
    folder.mkdir(parents=True, exist_ok=True)
    drawn = KINDS[kind](size, np.random.default_rng(seed))
    imageio.imwrite(path, drawn[..., 0] if drawn.shape[2] == 1 else drawn)
    return path
