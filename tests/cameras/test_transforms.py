import numpy as np
import pytest
import torch

from nerf_lightning.cameras import pixel_to_camera, transform, transform_directions

BATCHES = [((), ()), ((), (5,)), ((5,), ()), ((4, 1), (1, 3))]


@pytest.mark.parametrize(("cameras", "points"), BATCHES)
@pytest.mark.parametrize(("function", "w"), [(transform, 1.0), (transform_directions, 0.0)])
def test_transform_is_a_homogeneous_product(function, w, cameras, points, random_poses):
    c2w, x = random_poses(*cameras), torch.randn(*points, 3, dtype=torch.float64)
    homogeneous = np.concatenate([x.numpy(), np.full((*points, 1), w)], -1)[..., None]
    expected = np.matmul(c2w.numpy(), homogeneous)[..., :3, 0]
    actual = function(c2w, x)
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual, expected, atol=1e-12)


@pytest.mark.parametrize(("cameras", "points"), BATCHES)
def test_pixel_to_camera_inverts_K(cameras, points, random_K):
    K, uv = random_K(*cameras), 300 * torch.rand(*points, 2, dtype=torch.float64)
    depth = 1 + torch.rand(points, dtype=torch.float64)
    homogeneous = np.concatenate([uv.numpy(), np.ones((*points, 1))], -1)[..., None]
    expected = np.matmul(np.linalg.inv(K.numpy()), homogeneous)[..., 0] * depth.numpy()[..., None]
    actual = pixel_to_camera(K, uv, depth)
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual, expected, atol=1e-12)
