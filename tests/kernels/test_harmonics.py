import numpy as np
import pytest
import torch

from nerf_lightning.kernels import spherical_harmonics

PRECISIONS = pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-12), (torch.float32, 3e-6)])
"""Only the reference supports float64."""


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
