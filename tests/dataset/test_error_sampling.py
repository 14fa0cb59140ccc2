import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset import RayDataModule, Views
from nerf_lightning.dataset.error_sampling import UPDATE_EVERY, ErrorSampler
from nerf_lightning.synthetic.objects import MARBLE, make_object_scene

SIZES = [(40, 20), (16, 16), (7, 33)]


def make_views(masked: bool = False) -> Views:
    """Three sizes; each pixel's index is its color."""
    sizes = torch.tensor(SIZES)
    count = int(sizes.prod(1).sum())
    numbers = torch.arange(count)
    known = None
    if masked:  # a third of the pixels in one photo, half of a tile in another
        known = (numbers % 3 > 0) | (numbers > 800) & (numbers < 1000)
    pixels = torch.stack([numbers // 256, numbers % 256, 0 * numbers], dim=1).to(torch.uint8)
    return Views(pixels, Cameras(torch.eye(3).repeat(3, 1, 1), torch.eye(4).repeat(3, 1, 1), sizes), known)


def make_generator(seed: int = 0) -> Generator:
    return Generator().manual_seed(seed)


def make_trained_sampler(views: Views, errors: Tensor, share: float = 0.5, steps=2 * UPDATE_EVERY) -> ErrorSampler:
    """Sampler after steps with a fixed error per pixel."""
    sampler = ErrorSampler(views, share)
    for step in range(steps):
        pixels, _, tiles = sampler.draw(4000, make_generator(step))
        sampler.update(tiles, errors[pixels])
    return sampler


@pytest.mark.parametrize("masked", [False, True])
def test_error_sampler_weights_make_the_draw_unbiased(masked: bool):
    views = make_views(masked)
    known = views.mask.double()
    errors = torch.rand(len(known), generator=make_generator()) ** 4
    errors[:200] *= 0.01
    sampler = make_trained_sampler(views, errors)
    pixels, weights, _ = sampler.draw(400_000, make_generator(100))
    assert (weights[~views.mask[pixels]] == 0).all() and (weights[views.mask[pixels]] > 0).all()
    share = torch.zeros(len(known), dtype=torch.float64).index_add_(0, pixels, weights.double()) / len(pixels)
    torch.testing.assert_close(share.sum(), torch.tensor(1.0, dtype=torch.float64), rtol=0.01, atol=0)
    for part in (slice(0, 200), slice(200, 800), slice(800, 1056), slice(1056, None)):
        torch.testing.assert_close(share[part].sum(), known[part].sum() / known.sum(), rtol=0.05, atol=0)


def test_views_sample_pixels_is_uniform_over_valid_pixels():
    views = make_views(masked=True)
    counts = torch.bincount(views.sample_pixels(200_000, make_generator()), minlength=len(views.pixels)).double()
    expected = views.mask * (200_000 / int(views.mask.sum()))
    assert (counts[~views.mask] == 0).all() and ((counts - expected).abs() < 6 * expected.sqrt() + 1).all()


def test_error_sampler_draws_tiles_of_large_error():
    views = make_views()
    errors = torch.zeros(len(views.pixels))
    errors[800:1056] = 0.5  # the second photo, which is one tile
    pixels, _, _ = make_trained_sampler(views, errors).draw(20_000, make_generator(100))
    inside = ((pixels >= 800) & (pixels < 1056)).float().mean()
    assert inside == pytest.approx(0.5 + 0.5 * 256 / len(errors), abs=0.02)
    pixels, weights, _ = make_trained_sampler(views, 0 * errors).draw(20_000, make_generator(100))
    assert ((pixels >= 800) & (pixels < 1056)).float().mean() == pytest.approx(256 / len(errors), abs=0.02)
    torch.testing.assert_close(weights, torch.ones_like(weights), rtol=1e-5, atol=0)


def test_error_sampler_state_resumes_exactly():
    views = make_views()
    errors = torch.rand(len(views.pixels), generator=make_generator())
    whole, other = make_trained_sampler(views, errors, steps=UPDATE_EVERY + 5), ErrorSampler(views, 0.5)
    other.load_state_dict(whole.state_dict())
    for step in range(UPDATE_EVERY):
        pixels, weights, tiles = whole.draw(300, make_generator(step))
        assert all(map(torch.equal, other.draw(300, make_generator(step)), (pixels, weights, tiles)))
        whole.update(tiles, errors[pixels])
        order = torch.randperm(300)  # sums do not depend on it
        other.update(tiles[order], errors[pixels][order])
    assert all(map(torch.equal, whole.state_dict().values(), other.state_dict().values()))


def test_ray_data_error_map_raises_sampling():
    scene = make_object_scene(MARBLE, size=32, views=4, held_out=1)
    data = RayDataModule(scene, rays=500, samples=None)
    first = data.draw(0)
    for step in range(UPDATE_EVERY):
        batch = data.draw(step)
        data.update_error_map((batch.views == 1).float())
    assert (data.draw(UPDATE_EVERY).views == 1).float().mean() > 0.55
    resumed = RayDataModule(scene, rays=500, samples=None)
    resumed.load_state_dict(data.state_dict())
    assert torch.equal(resumed.draw(UPDATE_EVERY).pixels, data.draw(UPDATE_EVERY).pixels)
    data.reset()
    assert torch.equal(data.draw(0).pixels, first.pixels)
    assert RayDataModule(scene, rays=500, error_sampling=0).draw(0).weights is None
