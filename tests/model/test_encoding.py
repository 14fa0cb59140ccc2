import math

import jaxtyping
import numpy as np
import pytest
import torch

from nerf_lightning.model import sinusoidal, spherical_harmonics


@pytest.mark.parametrize("frequencies", [0, 1, 4])
@pytest.mark.parametrize("shape", [(5, 3), (2,), (2, 3, 1)])
def test_sinusoidal_agrees_with_a_loop(frequencies, shape):
    x = torch.randn(shape)
    rows = []
    for row in x.reshape(-1, shape[-1]).tolist():
        out = list(row)
        for octave in range(frequencies):
            out += [math.sin(2**octave * math.pi * v) for v in row]
            out += [math.cos(2**octave * math.pi * v) for v in row]
        rows.append(out)
    expected = torch.tensor(rows).view(*shape[:-1], shape[-1] * (1 + 2 * frequencies))
    torch.testing.assert_close(sinusoidal(x, frequencies), expected, atol=1e-5, rtol=1e-5)


def sphere() -> tuple[torch.Tensor, np.ndarray]:
    """Directions and weights of a quadrature exact for polynomials up to degree 15."""
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    r = np.sqrt(1 - z**2)[:, None]
    xyz = np.stack([r * np.cos(angle), r * np.sin(angle), np.broadcast_to(z[:, None], (8, 16))], -1)
    return torch.from_numpy(xyz.reshape(-1, 3)), (weight[:, None] * np.full(16, 2 * np.pi / 16)).ravel()


def test_spherical_harmonics_are_orthonormal():
    d, weight = sphere()
    y = spherical_harmonics(d).numpy()
    np.testing.assert_allclose(y.T @ (weight[:, None] * y), np.eye(16), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_each_degree_of_spherical_harmonics_is_in_its_place(degree):
    """The squares of a degree add up to (2 l + 1) / (4 pi) in every direction (Unsöld)."""
    d = torch.nn.functional.normalize(torch.randn(100, 3).double(), dim=-1)
    squares = spherical_harmonics(d)[:, degree**2 : (degree + 1) ** 2].square().sum(1)
    torch.testing.assert_close(squares, torch.full((100,), (2 * degree + 1) / (4 * math.pi)).double())
    sign = 1 if degree % 2 == 0 else -1
    block = slice(degree**2, (degree + 1) ** 2)
    torch.testing.assert_close(spherical_harmonics(-d)[:, block], sign * spherical_harmonics(d)[:, block])


def test_a_wrong_shape_is_refused_in_tests():
    with pytest.raises(jaxtyping.TypeCheckError):
        spherical_harmonics(torch.zeros(5, 2))
