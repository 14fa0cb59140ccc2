"""Photos of a folder: a few of them, and those of one size."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from nerf_lightning.errors import InputError

T = TypeVar("T")


def spread(items: Sequence[T], most: int) -> list[T]:
    """At most this many, evenly chosen, the first and the last among them."""
    if len(items) <= most:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int)]


def of_one_size(
    folder: Path, sizes: Mapping[str, tuple[int, int]], size: tuple[int, int] | None = None
) -> dict[str, str]:
    """Photos that do not have the commonest size (or `size`), and what is wrong with each.

    Args:
        folder: where they are, for the message.
        sizes: width and height by name.
        size: of the photos that were calibrated.

    Raises:
        InputError: no photo is of that size.
    """
    width, height = size or Counter(sizes.values()).most_common(1)[0][0]
    wrong = {}
    for name, (w, h) in sizes.items():
        if (w, h) != (width, height):
            turned = (h, w) == (width, height)
            advice = "held the other way" if turned else "of another size"
            wrong[name] = (
                f"{w}x{h} pixels, {advice}: {width}x{height} is what {'was calibrated' if size else 'most have'}"
            )
    if len(wrong) == len(sizes):
        name, reason = next(iter(wrong.items()))
        raise InputError(
            folder / name,
            "",
            reason,
            "photos of the size and orientation of the calibration",
            "take both with one camera, held one way, without zooming",
        )
    return wrong
