from collections.abc import Callable

import pytest
import torch

from nerf_lightning.dataset import Views, estimate_bounds

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def views(ball_views_of: Callable[..., Views]) -> Views:
    return ball_views_of(10)


def composite_on(views: Views, background: int) -> Views:
    alpha = views.images[..., 3:].float() / 255
    rgb = views.images[..., :3] * alpha + background * (1 - alpha)
    return Views.from_images(rgb.round().to(torch.uint8), views.cameras)


def assert_tight(box: torch.Tensor, truth: torch.Tensor, slack: float) -> None:
    """`box` contains `truth` and is at most `slack` times as long on each axis."""
    assert (box[0] <= truth[0]).all() and (box[1] >= truth[1]).all(), box
    assert ((box[1] - box[0]) / (truth[1] - truth[0])).max() < slack, box


@pytest.mark.parametrize("kind", ["alpha", "black", "white"])
def test_estimate_bounds_silhouettes_give_tight_box(kind: str, views: Views, ball_box: torch.Tensor):
    if kind != "alpha":
        views = composite_on(views, 0 if kind == "black" else 255)
    bounds = estimate_bounds(views, WHITE if kind == "white" else BLACK, near=1.0, far=7.0)
    # A pixel is 0.07 units wide here; one pass over the coarse grid would leave 1.27.
    assert_tight(bounds.aabb, ball_box, 1.23)
    assert not bounds.unbounded and (bounds.near, bounds.far) == (1.0, 7.0)


def test_estimate_bounds_broken_silhouettes_are_ignored(ball_views_of: Callable[..., Views], ball_box: torch.Tensor):
    views = ball_views_of(10)
    views.images[7] = 0
    assert_tight(estimate_bounds(views, BLACK).aabb, ball_box, 1.23)
    views.images[::3] = 0  # the ball is missing from a third of the views: too few agree on any voxel
    # The visible cube: 4 away from the origin, half of 48 pixels wide at a focal length of 60.
    seen = torch.tensor([[-1.6] * 3, [1.6] * 3])
    torch.testing.assert_close(estimate_bounds(views, BLACK).aabb, seen, atol=1e-4, rtol=0)
    noise = torch.randint(0, 256, (*views.images.shape[:3], 3), generator=torch.manual_seed(0)).to(torch.uint8)
    views = Views.from_images(noise, views.cameras)
    torch.testing.assert_close(estimate_bounds(views, BLACK).aabb, seen, atol=1e-4, rtol=0)
