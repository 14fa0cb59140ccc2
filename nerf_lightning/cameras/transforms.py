"""Pinhole geometry and rigid transforms. OpenCV frame: x right, y down, z forward; pixel centers at +0.5."""

import torch
from jaxtyping import Float
from torch import Tensor


def transform_points(
    c2w: Float[Tensor, "*#batch 4 4"], points: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Maps points from camera to world: x_w = R x_c + t, with c2w = [R t; 0 1]. Batches broadcast."""
    return transform_directions(c2w, points) + c2w[..., :3, 3]


def transform_directions(
    c2w: Float[Tensor, "*#batch 4 4"], directions: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Rotates directions from camera to world (no translation). Batches broadcast."""
    return (c2w[..., :3, :3] * directions[..., None, :]).sum(-1)


def transform_poses(c2w: Float[Tensor, "V 4 4"], similarity: Float[Tensor, "4 4"]) -> Float[Tensor, "V 4 4"]:
    """Transforms camera poses by a similarity (rotation, scale, translation), in double precision; they stay rigid."""
    transformed = similarity.double() @ c2w.double()
    transformed[:, :3, :3] /= torch.linalg.det(similarity[:3, :3].double()) ** (1 / 3)
    return transformed


def pixel_to_camera(
    K: Float[Tensor, "*#batch 3 3"], uv: Float[Tensor, "*#batch 2"], depth: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch 3"]:
    """Lifts pixels to the camera frame: x_c = depth * K^-1 [u, v, 1].

    Args:
        K: intrinsics [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels.
        uv: continuous pixel coordinates (x right, y down); the center of pixel (row, col) is (col + 0.5, row + 0.5).
        depth: distance along the camera's z axis, in the scene's unit.
    """
    normalized = pixels_to_normalized(K, uv)
    return torch.cat([normalized, torch.ones_like(normalized[..., :1])], dim=-1) * depth[..., None]


def pixels_to_normalized(K: Float[Tensor, "*#batch 3 3"], uv: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch 2"]:
    """Normalized coordinates (x/z, y/z of a pinhole camera) of pixels: K^-1 [u, v, 1] by back-substitution."""
    y = (uv[..., 1] - K[..., 1, 2]) / K[..., 1, 1]
    x = (uv[..., 0] - K[..., 0, 2] - K[..., 0, 1] * y) / K[..., 0, 0]
    return torch.stack([x, y], dim=-1)
