import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import plane_line_products, plane_line_sum, set_kernels
from nerf_lightning.kernels.vector_matrix import grid_sample_products

NAN = float("nan")
SIZES = pytest.mark.parametrize(("side", "channels"), [(7, 8), (5, 3)])


def factors(side: int, channels: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    return torch.randn(3, side, side, channels, dtype=dtype), torch.randn(3, side, channels, dtype=dtype)


def brute_force(planes: Tensor, lines: Tensor, unit: Tensor) -> Tensor:
    """TensoRF, eq. 3, term by term: all vertices, each with the weight of a tent around it."""
    side = lines.shape[1]
    rows = []
    for point in unit.double().clamp(0, 1).tolist():
        tents = [[max(0.0, 1 - abs(p * (side - 1) - i)) for i in range(side)] for p in point]
        row = []
        for mode, (a, b) in enumerate(((1, 2), (0, 2), (0, 1))):
            plane = sum(tents[a][i] * tents[b][j] * planes[mode, i, j] for i in range(side) for j in range(side))
            row.append(plane * sum(tents[mode][i] * lines[mode, i] for i in range(side)))
        rows.append(torch.cat(row))
    return torch.stack(rows)


@SIZES
def test_plane_line_products_any_size_match_loop_over_vertices(side: int, channels: int):
    planes, lines = factors(side, channels, torch.float64)
    ends = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0.5], [1, 0.25, 0], [-0.3, 0.5, 1.2]])
    unit = torch.cat([torch.rand(9, 3), ends])
    expected = brute_force(planes, lines, unit)
    torch.testing.assert_close(plane_line_products(planes, lines, unit.double()), expected, atol=1e-9, rtol=1e-9)
    for choice in ("auto", "reference"):
        set_kernels(choice)
        single = planes.float(), lines.float(), unit
        torch.testing.assert_close(plane_line_products(*single).double(), expected, atol=2e-5, rtol=1e-4)
        torch.testing.assert_close(plane_line_sum(*single).double(), expected.sum(1), atol=1e-4, rtol=1e-4)


@SIZES
def test_grid_sample_products_match_products(side: int, channels: int):
    planes, lines = (x.requires_grad_() for x in factors(side, channels, torch.float64))
    unit = (1.4 * torch.rand(50, 3, dtype=torch.float64) - 0.2).requires_grad_()
    got, expected = grid_sample_products(planes, lines, unit).flatten(1), plane_line_products(planes, lines, unit)
    torch.testing.assert_close(got, expected)
    above = torch.randn_like(expected)
    gradients = (torch.autograd.grad(out, (planes, lines, unit), above) for out in (got, expected))
    torch.testing.assert_close(*gradients)
    bad = torch.tensor([[0.5, NAN, 0.5], [0.5, 0.5, 0.5]], dtype=torch.float64)
    assert grid_sample_products(planes, lines, bad).isnan().flatten(1).all(1).tolist() == [True, False]
