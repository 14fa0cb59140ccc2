import pytest
import torch

from nerf_lightning.dataset import Picture, PixelDataModule

HEIGHT, WIDTH = 4, 7


@pytest.fixture
def picture() -> Picture:
    """Every pixel's colour says which one it is: (row, column, 255)."""
    row, col = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return Picture("labels", "test", torch.stack([row, col, torch.full_like(row, 255)], dim=-1).to(torch.uint8))


def test_pixel_data_places_have_their_colours(picture: Picture):
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
    assert (view.height, view.width) == (HEIGHT, WIDTH) and data.held_out_views == 1
    assert torch.equal(view.rgb.view(HEIGHT, WIDTH, 3), picture.image.float() / 255)
    assert (view.uv.view(HEIGHT, WIDTH, 2)[..., 0].diff(dim=1) > 0).all()
    assert (view.uv.view(HEIGHT, WIDTH, 2)[..., 1].diff(dim=0) > 0).all()


def test_picture_sha256_tells_pictures_apart(picture: Picture):
    other = Picture("labels", "test", picture.image.clone())
    assert other.sha256() == picture.sha256()
    other.image[0, 0, 0] += 1
    turned = Picture("labels", "test", picture.image.reshape(WIDTH, HEIGHT, 3))
    assert len({picture.sha256(), other.sha256(), turned.sha256()}) == 3
    assert picture.describe()["resolution"] == [WIDTH, HEIGHT]


@pytest.mark.parametrize(("side", "expected"), [(7, 8192), (1024, 8192), (2048, 32768)])
def test_pixel_data_large_picture_draws_more(side: int, expected: int):
    data = PixelDataModule(Picture("black", "test", torch.zeros(side, side, 3, dtype=torch.uint8)))
    assert data.pixels == len(data.draw(0).uv) == expected
