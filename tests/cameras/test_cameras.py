import pytest
import torch

from nerf_lightning.cameras import Cameras
from tests.cameras.conftest import cast_ray, random_K, random_poses


@pytest.fixture
def cameras() -> Cameras:
    return Cameras.pinhole(random_K(3), random_poses(3), width=7, height=5)


def test_generate_rays_of_pixels_pass_pixel_centers(cameras):
    view, row, col = torch.tensor([2, 0, 1, 2]), torch.tensor([4, 0, 3, 1]), torch.tensor([6, 0, 2, 5])
    rays = cameras.generate_rays(view, row, col)
    for i in range(4):
        uv = torch.tensor([col[i] + 0.5, row[i] + 0.5], dtype=torch.float64)
        origin, direction = cast_ray(cameras.K[view[i]], cameras.c2w[view[i]], uv)
        torch.testing.assert_close(rays.origins[i], origin, rtol=0, atol=1e-14)
        torch.testing.assert_close(rays.directions[i], direction, rtol=0, atol=1e-14)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(4).double())


@pytest.mark.parametrize(("width", "height"), [(14, 10), (3, 5)])
def test_resize_to_other_grids_keeps_rays(cameras, width, height):
    small = cameras.resize((width, height))
    fraction = torch.rand(3, 2, dtype=torch.float64)
    before = cast_ray(cameras.K, cameras.c2w, fraction * torch.tensor([7, 5]))
    after = cast_ray(small.K, small.c2w, fraction * torch.tensor([width, height]))
    torch.testing.assert_close(after, before)
    assert (small.width, small.height) == (width, height)
    assert torch.equal(small.K[:, 2], cameras.K[:, 2])


def test_getitem_with_any_index_picks_views(cameras):
    picked = cameras[torch.tensor([2, 0])]
    assert len(picked) == 2 and torch.equal(picked.centers, cameras.c2w[[2, 0], :3, 3])
    assert torch.equal(picked.K, cameras.K[[2, 0]]) and (picked.width, picked.height) == (7, 5)
