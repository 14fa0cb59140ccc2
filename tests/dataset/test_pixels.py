import pytest
import torch

from nerf_lightning.dataset import Picture, PixelDataModule
from nerf_lightning.errors import InputError

HEIGHT, WIDTH = 4, 7


@pytest.fixture
def picture() -> Picture:
    """Every pixel's colour says which one it is: (row, column, 255)."""
    row, col = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    return Picture("labels", "test", torch.stack([row, col, torch.full_like(row, 255)], dim=-1).to(torch.uint8))


def test_drawn_places_have_the_colours_of_their_pixels(picture: Picture):
    batch = PixelDataModule(picture, pixels=500).draw(0)
    assert batch.uv.shape == (500, 2) and batch.rgb.shape == (500, 3)
    row, col = (batch.rgb[:, :2] * 255).round().unbind(-1)
    torch.testing.assert_close(batch.uv, torch.stack([(col + 0.5) / WIDTH, (row + 0.5) / HEIGHT], dim=-1))
    assert batch.uv.min() > 0 and batch.uv.max() < 1
    assert (batch.rgb[:, 2] == 1).all()
    assert len(set(map(tuple, batch.uv.tolist()))) == HEIGHT * WIDTH, "every pixel has its turn"


def test_the_whole_picture_is_judged_row_by_row(picture: Picture):
    data = PixelDataModule(picture, pixels=3)
    (view,) = data.test_dataloader()
    assert (view.height, view.width) == (HEIGHT, WIDTH) and data.held_out_views == 1
    assert torch.equal(view.rgb.view(HEIGHT, WIDTH, 3), picture.image.float() / 255)
    assert (view.uv.view(HEIGHT, WIDTH, 2)[..., 0].diff(dim=1) > 0).all()
    assert (view.uv.view(HEIGHT, WIDTH, 2)[..., 1].diff(dim=0) > 0).all()


def test_a_batch_depends_on_seed_and_step_alone(picture: Picture):
    def places(seed: int, step: int) -> list:
        return PixelDataModule(picture, pixels=30, seed=seed).draw(step).uv.tolist()

    assert places(0, 7) == places(0, 7)
    assert len({str(places(seed, step)) for seed in (0, 1) for step in range(20)}) == 40


def test_the_fingerprint_tells_pictures_apart(picture: Picture):
    other = Picture("labels", "test", picture.image.clone())
    assert other.sha256() == picture.sha256()
    other.image[0, 0, 0] += 1
    turned = Picture("labels", "test", picture.image.reshape(WIDTH, HEIGHT, 3))
    assert len({picture.sha256(), other.sha256(), turned.sha256()}) == 3
    assert picture.describe()["resolution"] == [WIDTH, HEIGHT]


@pytest.mark.parametrize(("side", "expected"), [(7, 8192), (1024, 8192), (2048, 32768)])
def test_a_step_looks_at_a_share_of_large_pictures(side: int, expected: int):
    data = PixelDataModule(Picture("black", "test", torch.zeros(side, side, 3, dtype=torch.uint8)))
    assert data.pixels == len(data.draw(0).uv) == expected


def test_less_than_one_pixel_is_refused(picture: Picture):
    with pytest.raises(InputError, match="dataset.pixels"):
        PixelDataModule(picture, pixels=0)
