from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.dataset import pixel_grid
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.sources import from_picture


def board(height: int, width: int) -> torch.Tensor:
    """Every other pixel white."""
    y, x = np.mgrid[:height, :width]
    return torch.from_numpy(np.where((x + y) % 2, 0, 200).astype(np.uint8)[..., None].repeat(3, axis=2))


def test_pixel_grid_is_row_by_row():
    grid = pixel_grid(2, 4)
    assert grid.tolist() == [[x, y] for y in (0.25, 0.75) for x in (0.125, 0.375, 0.625, 0.875)]


@pytest.mark.parametrize("max_side", [None, 6])
def test_from_picture_file_is_known_up_to_its_size(max_side, tmp_path: Path):
    path = tmp_path / "Board.png"
    imageio.imwrite(path, board(8, 12).numpy())
    picture = from_picture(str(path), max_side=max_side).scene
    assert picture.size == ((12, 8) if max_side is None else (6, 4)) and picture.name == "board"
    assert torch.equal(picture.at(12, 8), board(8, 12))
    assert max_side is None or (picture.image == 100).all(), "averages"
    assert picture.at(24, 16) is None


@pytest.mark.parametrize("max_side", [16, None])
def test_from_picture_builtin_is_known_at_any_size(max_side):
    picture = from_picture(max_side=max_side).scene
    assert picture.size == ((16, 16) if max_side else (256, 256))
    assert torch.equal(picture.at(*picture.size), picture.image)
    assert torch.equal(picture.at(40, 40), builtin_picture(40))
