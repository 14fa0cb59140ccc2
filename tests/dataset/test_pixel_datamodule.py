from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.datamodules import build_picture_data
from nerf_lightning.dataset import Picture, PixelDataModule, make_builtin_picture, pixel_grid

HEIGHT, WIDTH = 4, 7


@pytest.fixture
def picture() -> Picture:
    """Each pixel's color encodes its position: (row, column, 255)."""
    row, col = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return Picture("labels", "test", torch.stack([row, col, torch.full_like(row, 255)], dim=-1).to(torch.uint8))


def test_pixel_data_coordinates_match_colors(picture: Picture):
    batch = PixelDataModule(picture, pixels=500).draw(0)
    assert batch.uv.shape == (500, 2) and batch.rgb.shape == (500, 3)
    row, col = (batch.rgb[:, :2] * 255).round().unbind(-1)
    torch.testing.assert_close(batch.uv, torch.stack([(col + 0.5) / WIDTH, (row + 0.5) / HEIGHT], dim=-1))
    assert batch.uv.min() > 0 and batch.uv.max() < 1
    assert (batch.rgb[:, 2] == 1).all()
    assert len(set(map(tuple, batch.uv.tolist()))) == HEIGHT * WIDTH, "every pixel has its turn"


def test_pixel_data_held_out_is_the_whole_picture(picture: Picture):
    data = PixelDataModule(picture, pixels=3)
    (view,) = data.test_dataloader()
    assert (view.height, view.width) == (HEIGHT, WIDTH) and data.num_held_out_views == 1
    assert torch.equal(view.rgb.view(HEIGHT, WIDTH, 3), picture.image.float() / 255)
    assert torch.equal(view.uv, pixel_grid(HEIGHT, WIDTH))


def test_pixel_data_large_picture_has_larger_batch():
    for side, expected in ((1024, 8192), (2048, 32768)):
        data = PixelDataModule(Picture("black", "test", torch.zeros(side, side, 3, dtype=torch.uint8)))
        assert data.pixels == len(data.draw(0).uv) == expected


def test_pixel_grid_is_row_by_row():
    grid = pixel_grid(2, 4)
    assert grid.tolist() == [[x, y] for y in (0.25, 0.75) for x in (0.125, 0.375, 0.625, 0.875)]


@pytest.mark.parametrize("max_side", [None, 6])
def test_build_picture_data_file_has_references_up_to_its_size(max_side, tmp_path: Path):
    path, (y, x) = tmp_path / "Board.png", np.mgrid[:8, :12]
    board = np.where((x + y) % 2, 0, 200).astype(np.uint8)[..., None].repeat(3, axis=2)
    imageio.imwrite(path, board)
    picture = build_picture_data(str(path), max_side=max_side).scene
    assert picture.size == ((12, 8) if max_side is None else (6, 4)) and picture.name == "board"
    assert torch.equal(picture.make_reference(12, 8), torch.from_numpy(board))
    assert max_side is None or (picture.image == 100).all(), "averages"
    assert picture.make_reference(24, 16) is None


def test_build_picture_data_builtin_has_reference_at_any_size():
    picture = build_picture_data(max_side=16).scene
    assert picture.size == (16, 16) and build_picture_data().scene.size == (256, 256)
    assert torch.equal(picture.make_reference(*picture.size), picture.image)
    assert torch.equal(picture.make_reference(40, 40), make_builtin_picture(40))
