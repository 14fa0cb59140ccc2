import pytest
import torch

from nerf_lightning.cameras import Cameras
from tests.cameras.conftest import cast_ray, random_K, random_poses


@pytest.fixture
def cameras() -> Cameras:
    return Cameras.of_size(random_K(3), random_poses(3), width=7, height=5)


def test_rays_pass_pixel_centres(cameras):
    view, row, col = torch.tensor([2, 0, 1, 2]), torch.tensor([4, 0, 3, 1]), torch.tensor([6, 0, 2, 5])
    rays = cameras.rays(view, row, col)
    for i in range(4):
        uv = torch.tensor([col[i] + 0.5, row[i] + 0.5], dtype=torch.float64)
        origin, direction = cast_ray(cameras.K[view[i]], cameras.c2w[view[i]], uv)
        torch.testing.assert_close(rays.origins[i], origin, rtol=0, atol=1e-14)
        torch.testing.assert_close(rays.directions[i], direction, rtol=0, atol=1e-14)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(4).double())


@pytest.mark.parametrize(("width", "height"), [(14, 10), (3, 5)])
def test_resized_keeps_rays(cameras, width, height):
    small = cameras.resized((width, height))
    share = torch.rand(3, 2, dtype=torch.float64)
    before = cast_ray(cameras.K, cameras.c2w, share * torch.tensor([7, 5]))
    after = cast_ray(small.K, small.c2w, share * torch.tensor([width, height]))
    torch.testing.assert_close(after, before)
    assert (small.width, small.height) == (width, height)
    assert torch.equal(small.K[:, 2], cameras.K[:, 2])


def test_getitem_picks_views(cameras):
    picked = cameras[torch.tensor([2, 0])]
    assert len(picked) == 2 and torch.equal(picked.centres, cameras.c2w[[2, 0], :3, 3])
    assert torch.equal(picked.K, cameras.K[[2, 0]]) and (picked.width, picked.height) == (7, 5)
