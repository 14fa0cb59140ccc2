import jaxtyping
import numpy as np
import pytest
import torch

from nerf_lightning.cameras import pixel_to_camera, pixel_to_ray, transform, transform_directions

BATCHES = [((), ()), ((5,), (5,)), ((), (5,)), ((5,), ()), ((4, 1), (1, 3)), ((2, 3), (2, 3)), ((3,), (2, 1))]


@pytest.mark.parametrize(("cameras", "points"), BATCHES)
@pytest.mark.parametrize(("function", "w"), [(transform, 1.0), (transform_directions, 0.0)])
def test_transforms_are_homogeneous_products(function, w, cameras, points, random_poses):
    c2w, x = random_poses(*cameras), torch.randn(*points, 3, dtype=torch.float64)
    homogeneous = np.concatenate([x.numpy(), np.full((*points, 1), w)], -1)[..., None]
    expected = np.matmul(c2w.numpy(), homogeneous)[..., :3, 0]
    actual = function(c2w, x)
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual, expected, atol=1e-12)


@pytest.mark.parametrize(("cameras", "points"), BATCHES)
def test_lifting_inverts_K(cameras, points, random_K):
    K, uv = random_K(*cameras), 300 * torch.rand(*points, 2, dtype=torch.float64)
    depth = 1 + torch.rand(points, dtype=torch.float64)
    homogeneous = np.concatenate([uv.numpy(), np.ones((*points, 1))], -1)[..., None]
    expected = np.matmul(np.linalg.inv(K.numpy()), homogeneous)[..., 0] * depth.numpy()[..., None]
    actual = pixel_to_camera(K, uv, depth)
    assert actual.shape == expected.shape
    np.testing.assert_allclose(actual, expected, atol=1e-12)


@pytest.mark.parametrize(("cameras", "points"), BATCHES)
def test_rays_start_at_the_camera_and_pass_the_lifted_pixel(cameras, points, random_K, random_poses):
    K, c2w, uv = random_K(*cameras), random_poses(*cameras), 300 * torch.rand(*points, 2, dtype=torch.float64)
    homogeneous = np.concatenate([uv.numpy(), np.ones((*points, 1))], -1)[..., None]
    lifted = np.matmul(np.linalg.inv(K.numpy()), homogeneous)
    ray = np.matmul(c2w.numpy()[..., :3, :3], lifted)[..., 0]
    origins, directions = pixel_to_ray(K, c2w, uv)
    assert origins.shape == directions.shape == ray.shape
    np.testing.assert_allclose(directions, ray / np.linalg.norm(ray, axis=-1, keepdims=True), atol=1e-12)
    np.testing.assert_array_equal(origins, np.broadcast_to(c2w.numpy()[..., :3, 3], ray.shape))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_a_projected_point_lies_on_the_ray_through_its_pixel(dtype, tolerance, random_K, random_poses):
    K, c2w = random_K(500), random_poses(500)
    camera = torch.randn(500, 3, dtype=torch.float64) + torch.tensor([0, 0, 5.0])
    camera[:, 2].clamp_(min=0.5)
    world = np.matmul(c2w.numpy(), np.append(camera.numpy(), np.ones((500, 1)), 1)[..., None])[:, :3, 0]
    projected = np.matmul(
        K.numpy(), np.matmul(np.linalg.inv(c2w.numpy()), np.append(world, np.ones((500, 1)), 1)[..., None])[:, :3]
    )[..., 0]
    uv = torch.from_numpy(projected[:, :2] / projected[:, 2:])
    origins, directions = (x.numpy() for x in pixel_to_ray(K.to(dtype), c2w.to(dtype), uv.to(dtype)))
    assert np.linalg.norm(np.cross(world - origins, directions), axis=-1).max() < tolerance
    assert ((world - origins) * directions).sum(-1).min() > 0
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)


@pytest.mark.parametrize(
    "call",
    [
        lambda: transform(torch.eye(4), torch.zeros(5, 2)),
        lambda: transform(torch.eye(3), torch.zeros(5, 3)),
        lambda: transform(torch.eye(4).repeat(4, 1, 1), torch.zeros(5, 3)),
        lambda: pixel_to_camera(torch.eye(3), torch.zeros(5, 2), torch.ones(4)),
        lambda: pixel_to_ray(torch.eye(3), torch.eye(4), torch.zeros(5, 2, dtype=torch.int64)),
    ],
)
def test_a_wrong_shape_or_type_is_refused_in_tests(call):
    with pytest.raises(jaxtyping.TypeCheckError):
        call()
