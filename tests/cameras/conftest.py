"""Random cameras, and a reference for their rays."""

import torch
from torch import Tensor


def random_poses(*batch: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Random rotations (det = 1) and translations."""
    q = torch.linalg.qr(torch.randn(*batch, 3, 3, dtype=torch.float64)).Q
    q = q * torch.linalg.det(q)[..., None, None].sign()
    c2w = torch.eye(4, dtype=torch.float64).repeat(*batch, 1, 1)
    c2w[..., :3, :3], c2w[..., :3, 3] = q, torch.randn(*batch, 3, dtype=torch.float64) * 3
    return c2w.to(dtype)


def random_K(*batch: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Random upper triangular K, with skew."""
    K = torch.zeros(*batch, 3, 3, dtype=torch.float64)
    K[..., 0, 0] = 200 + 300 * torch.rand(batch)
    K[..., 1, 1] = 200 + 300 * torch.rand(batch)
    K[..., 0, 1] = 20 * torch.randn(batch)
    K[..., :2, 2] = 100 + 50 * torch.rand(*batch, 2, dtype=torch.float64)
    K[..., 2, 2] = 1
    return K.to(dtype)


def cast_ray(K: Tensor, c2w: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Origin and unit direction, world frame, of the ray through a pixel: a reference."""
    pixel = torch.cat([uv, torch.ones_like(uv[..., :1])], dim=-1)[..., None]
    directions = (c2w[..., :3, :3] @ torch.linalg.inv(K) @ pixel)[..., 0]
    return c2w[..., :3, 3].expand_as(directions), torch.nn.functional.normalize(directions, dim=-1)
