from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.dataset import Picture, pixel_grid
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.dataset.sources import from_picture, no_larger_than


def board(height: int, width: int) -> torch.Tensor:
    """Every other pixel white."""
    y, x = np.mgrid[:height, :width]
    return torch.from_numpy(np.where((x + y) % 2, 0, 200).astype(np.uint8)[..., None].repeat(3, axis=2))


def test_a_grid_holds_the_centres_of_all_pixels_row_by_row():
    grid = pixel_grid(2, 4)
    assert grid.tolist() == [[x, y] for y in (0.25, 0.75) for x in (0.125, 0.375, 0.625, 0.875)]


def test_a_picture_is_known_at_sizes_up_to_its_own():
    original = board(8, 12)
    assert torch.equal(no_larger_than(original, 12, 8), original)
    smaller = no_larger_than(original, 6, 4)
    assert smaller.shape == (4, 6, 3) and (smaller == 100).all(), "averaged"
    assert no_larger_than(original, 14, 8) is None and no_larger_than(original, 12, 10) is None, (
        "one more may be rounding"
    )


def test_nothing_is_known_of_a_picture_that_does_not_say():
    picture = Picture("p", "test", board(8, 12))
    assert picture.at(4, 4) is None and picture.at(12, 8) is None and picture.size == (12, 8)


@pytest.mark.parametrize("max_side", [None, 6])
def test_a_file_is_known_up_to_its_own_size_however_small_it_trains(max_side, tmp_path: Path):
    path = tmp_path / "Board.png"
    imageio.imwrite(path, board(8, 12).numpy())
    picture = from_picture(str(path), max_side=max_side).scene
    assert picture.size == ((12, 8) if max_side is None else (6, 4)) and picture.name == "board"
    assert torch.equal(picture.at(12, 8), board(8, 12))
    assert picture.at(24, 16) is None


@pytest.mark.parametrize("max_side", [16, None])
def test_the_built_in_picture_is_known_at_any_size(max_side):
    picture = from_picture(max_side=max_side).scene
    assert picture.size == ((16, 16) if max_side else (256, 256))
    assert torch.equal(picture.at(*picture.size), picture.image)
    assert torch.equal(picture.at(40, 40), builtin_picture(40))
