import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset import RayDataModule, Views
from nerf_lightning.dataset.focus import EVERY, Focus
from nerf_lightning.synthetic.objects import MARBLE, make_scene

SIZES = [(40, 20), (16, 16), (7, 33)]


def photos(masked: bool = False) -> Views:
    """Three sizes; each pixel's number is its colour."""
    sizes = torch.tensor(SIZES)
    count = int(sizes.prod(1).sum())
    numbers = torch.arange(count)
    known = None
    if masked:  # a third of the pixels in one photo, half of a tile in another
        known = (numbers % 3 > 0) | (numbers > 800) & (numbers < 1000)
    pixels = torch.stack([numbers // 256, numbers % 256, 0 * numbers], dim=1).to(torch.uint8)
    return Views(pixels, Cameras(torch.eye(3).repeat(3, 1, 1), torch.eye(4).repeat(3, 1, 1), sizes), known)


def seeded(seed: int = 0) -> Generator:
    return Generator().manual_seed(seed)


def taught(views: Views, errors: Tensor, share: float = 0.5, steps: int = 2 * EVERY) -> Focus:
    """After some steps in which each pixel had its own error."""
    focus = Focus(views, share)
    for step in range(steps):
        places, _ = focus.draw(4000, seeded(step))
        focus.note(errors[places])
    return focus


@pytest.mark.parametrize("masked", [False, True])
def test_focus_weights_make_the_draw_unbiased(masked: bool):
    views = photos(masked)
    known = views.mask.double()
    errors = torch.rand(len(known), generator=seeded()) ** 4
    errors[:200] *= 0.01
    focus = taught(views, errors)
    places, weights = focus.draw(400_000, seeded(100))
    assert (weights[~views.mask[places]] == 0).all() and (weights[views.mask[places]] > 0).all()
    share = torch.zeros(len(known), dtype=torch.float64).index_add_(0, places, weights.double()) / len(places)
    torch.testing.assert_close(share.sum(), torch.tensor(1.0, dtype=torch.float64), rtol=0.01, atol=0)
    for part in (slice(0, 200), slice(200, 800), slice(800, 1056), slice(1056, None)):
        torch.testing.assert_close(share[part].sum(), known[part].sum() / known.sum(), rtol=0.05, atol=0)


def test_views_draw_known_pixels_evenly():
    views = photos(masked=True)
    counts = torch.bincount(views.draw(200_000, seeded()), minlength=len(views.pixels)).double()
    expected = views.mask * (200_000 / int(views.mask.sum()))
    assert (counts[~views.mask] == 0).all() and ((counts - expected).abs() < 6 * expected.sqrt() + 1).all()


def test_focus_draws_where_the_error_is():
    views = photos()
    errors = torch.zeros(len(views.pixels))
    errors[800:1056] = 0.5  # the second photo, which is one tile
    places, _ = taught(views, errors).draw(20_000, seeded(100))
    inside = ((places >= 800) & (places < 1056)).float().mean()
    assert inside == pytest.approx(0.5 + 0.5 * 256 / len(errors), abs=0.02)
    places, weights = taught(views, 0 * errors).draw(20_000, seeded(100))
    assert ((places >= 800) & (places < 1056)).float().mean() == pytest.approx(256 / len(errors), abs=0.02)
    torch.testing.assert_close(weights, torch.ones_like(weights), rtol=1e-5, atol=0)


def test_focus_state_resumes_exactly():
    views = photos()
    errors = torch.rand(len(views.pixels), generator=seeded())
    whole, other = taught(views, errors, steps=EVERY + 5), Focus(views, 0.5)
    other.load_state_dict(whole.state_dict())
    for step in range(EVERY):
        places, weights = whole.draw(300, seeded(step))
        assert all(map(torch.equal, other.draw(300, seeded(step)), (places, weights)))
        whole.note(errors[places])
        order = torch.randperm(300)  # sums do not depend on it
        other.drawn = other.drawn[order]
        other.note(errors[places][order])
    assert all(map(torch.equal, whole.state_dict().values(), other.state_dict().values()))


def test_ray_data_follows_noted_errors():
    scene = make_scene(MARBLE, size=32, views=4, held_out=1)
    data = RayDataModule(scene, rays=500, samples=None)
    first = data.draw(0)
    for step in range(EVERY):
        batch = data.draw(step)
        data.note_errors((batch.views == 1).float())
    assert (data.draw(EVERY).views == 1).float().mean() > 0.55
    resumed = RayDataModule(scene, rays=500, samples=None)
    resumed.load_state_dict(data.state_dict())
    assert torch.equal(resumed.draw(EVERY).pixels, data.draw(EVERY).pixels)
    data.start_again()
    assert torch.equal(data.draw(0).pixels, first.pixels)
    assert RayDataModule(scene, rays=500, focus=0).draw(0).weights is None
