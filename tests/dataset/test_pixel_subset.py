"""Evenly spaced subsets of a view's pixels."""

import pytest
import torch

from nerf_lightning.dataset import Picture, PixelDataModule, RayDataModule
from nerf_lightning.dataset.pixel_subset import ALL_PIXELS, PixelSubset, make_subset
from nerf_lightning.synthetic.bricks import bricks


def test_pixel_subset_row_fraction_gives_spaced_strips():
    rows, columns = PixelSubset(row_fraction=0.5).grid(7, 128)
    assert rows.tolist() == [*range(32), *range(64, 96)] and columns.tolist() == list(range(7))
    assert len(PixelSubset(row_fraction=0.0).grid(7, 128)[0]) == 32, "at least one"
    assert PixelSubset(row_fraction=0.3).grid(5, 20)[0].tolist() == list(range(20)), "less than a strip is there"
    assert PixelSubset(row_fraction=0.99).grid(5, 128)[0].tolist() == list(range(128))


def test_pixel_subset_stride_takes_the_middle():
    rows, columns = PixelSubset(stride=3).grid(7, 5)
    assert rows.tolist() == [1, 4] and columns.tolist() == [1, 4]
    assert [len(side) for side in PixelSubset(stride=9).grid(3, 2)] == [1, 1], "never nothing"
    for pixels, most, stride in ((100, 100, 1), (100, 99, 2), (100, 24, 3), (9, 0, 3)):
        assert make_subset(pixels, most).stride == stride
    assert (make_subset(100, 100) == ALL_PIXELS) and make_subset(100, 25).strip == 1


@pytest.mark.parametrize("subset", [PixelSubset(stride=3), PixelSubset(row_fraction=0.5)])
def test_held_out_subset_is_of_the_whole_view(subset: PixelSubset):
    scene = bricks(size=64, train_views=2, val_views=2)
    data = RayDataModule(scene)
    whole, some = data.get_held_out_view(1), data.get_held_out_view(1, subset)
    rows, columns = subset.grid(64, 64)
    expected = (rows[:, None] * 64 + columns).flatten()
    assert (some.height, some.width, some.strip) == (len(rows), len(columns), subset.strip)
    assert torch.equal(some.pixels, whole.pixels[expected]) and data.count_held_out_pixels(1) == len(whole.pixels)
    assert torch.equal(some.rays.directions, whole.rays.directions[expected])
    image = torch.randint(0, 256, (64, 40, 3), dtype=torch.uint8)
    picture = PixelDataModule(Picture("noise", "test", image))
    whole, some = picture.get_held_out_view(0), picture.get_held_out_view(0, subset)
    expected = (rows[:, None] * 40 + columns[columns < 40]).flatten()
    assert torch.equal(some.rgb, whole.rgb[expected]) and torch.allclose(some.uv, whole.uv[expected])
