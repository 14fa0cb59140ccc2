import math

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.kernels import spherical_harmonics

PRECISIONS = pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-12), (torch.float32, 3e-6)])
"""The reference alone speaks double precision."""


def sphere() -> tuple[torch.Tensor, np.ndarray]:
    """Directions and weights of a quadrature exact for polynomials up to degree 15."""
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    r = np.sqrt(1 - z**2)[:, None]
    xyz = np.stack([r * np.cos(angle), r * np.sin(angle), np.broadcast_to(z[:, None], (8, 16))], -1)
    return torch.from_numpy(xyz.reshape(-1, 3)), (weight[:, None] * np.full(16, 2 * np.pi / 16)).ravel()


@PRECISIONS
def test_harmonics_on_sphere_are_orthonormal(dtype: torch.dtype, atol: float):
    d, weight = sphere()
    y = spherical_harmonics(d.to(dtype)).double().numpy()
    np.testing.assert_allclose(y.T @ (weight[:, None] * y), np.eye(16), atol=atol)


@PRECISIONS
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_each_degree_follows_unsoeld(degree: int, dtype: torch.dtype, atol: float):
    """The squares of a degree add up to (2 l + 1) / (4 pi) in every direction (Unsöld)."""
    d = normalize(torch.randn(100, 3, dtype=torch.float64), dim=-1).to(dtype)
    block = slice(degree**2, (degree + 1) ** 2)
    squares = spherical_harmonics(d)[:, block].square().sum(1)
    expected = torch.full((100,), (2 * degree + 1) / (4 * math.pi), dtype=dtype)
    torch.testing.assert_close(squares, expected, atol=atol, rtol=0)
    sign = 1 if degree % 2 == 0 else -1
    torch.testing.assert_close(spherical_harmonics(-d)[:, block], sign * spherical_harmonics(d)[:, block])
