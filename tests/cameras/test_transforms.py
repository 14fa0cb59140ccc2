import numpy as np
import pytest
import torch

from nerf_lightning.cameras import pixel_to_camera, transform_directions, transform_points
from tests.cameras.conftest import random_K, random_poses


@pytest.mark.parametrize(("cameras", "points"), [((), ()), ((4, 1), (1, 3))])
def test_transform_points_and_directions_are_homogeneous_products(cameras, points):
    c2w, x = random_poses(*cameras), torch.randn(*points, 3, dtype=torch.float64)
    for function, w in ((transform_points, 1.0), (transform_directions, 0.0)):
        homogeneous = np.concatenate([x.numpy(), np.full((*points, 1), w)], -1)[..., None]
        np.testing.assert_allclose(function(c2w, x), np.matmul(c2w.numpy(), homogeneous)[..., :3, 0], atol=1e-12)
    K, uv, depth = random_K(*cameras), 300 * x[..., :2], 1 + torch.rand(points, dtype=torch.float64)
    homogeneous = np.concatenate([uv.numpy(), np.ones((*points, 1))], -1)[..., None]
    expected = np.matmul(np.linalg.inv(K.numpy()), homogeneous)[..., 0] * depth.numpy()[..., None]
    np.testing.assert_allclose(pixel_to_camera(K, uv, depth), expected, atol=1e-11)
