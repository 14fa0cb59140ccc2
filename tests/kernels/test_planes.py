import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import plane_line_products, plane_line_sum, use_kernels
from nerf_lightning.kernels.planes import sampled_products
from tests.helpers.assert_close import assert_agrees

NAN = float("nan")
READS = pytest.mark.parametrize("read", [plane_line_products, plane_line_sum])
SIZES = pytest.mark.parametrize(("side", "channels"), [(2, 8), (7, 8), (5, 3)])


def factors(side: int, channels: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    return torch.randn(3, side, side, channels, dtype=dtype), torch.randn(3, side, channels, dtype=dtype)


def by_hand(planes: Tensor, lines: Tensor, unit: Tensor) -> Tensor:
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
def test_products_and_their_sum_agree_with_a_loop_over_vertices(side: int, channels: int):
    planes, lines = factors(side, channels, torch.float64)
    ends = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0.5], [1, 0.25, 0], [-0.3, 0.5, 1.2]])
    unit = torch.cat([torch.rand(9, 3), ends])
    expected = by_hand(planes, lines, unit)
    torch.testing.assert_close(plane_line_products(planes, lines, unit.double()), expected, atol=1e-9, rtol=1e-9)
    for choice in ("auto", "reference"):
        use_kernels(choice)
        single = planes.float(), lines.float(), unit
        torch.testing.assert_close(plane_line_products(*single).double(), expected, atol=2e-5, rtol=1e-4)
        torch.testing.assert_close(plane_line_sum(*single).double(), expected.sum(1), atol=1e-4, rtol=1e-4)


@READS
@SIZES
@pytest.mark.parametrize("samples", [0, 1, 512, 2000])
def test_the_fast_version_agrees_with_the_reference(read, side: int, channels: int, samples: int):
    unit = 1.2 * torch.rand(samples, 3) - 0.1
    assert_agrees(read, [*factors(side, channels), unit], atol=3e-6)


@READS
def test_transposed_positions_and_factors_are_read_alike(read, kernels: str):
    (planes, lines), unit = factors(5, 8), torch.rand(3, 100)
    expected = read(planes, lines, unit.T.contiguous())
    strided = planes.permute(0, 3, 1, 2).contiguous().permute(0, 2, 3, 1), lines.mT.contiguous().mT
    assert torch.equal(read(planes, lines, unit.T), expected)
    assert torch.equal(read(*strided, unit.T), expected)


def test_gradients_of_planes_lines_and_positions():
    planes, lines = (x.requires_grad_() for x in factors(4, 2, torch.float64))
    # Away from the borders, where the slope jumps.
    unit = ((torch.randint(0, 3, (5, 3)) + 0.2 + 0.6 * torch.rand(5, 3)) / 3).double().requires_grad_()
    assert torch.autograd.gradcheck(plane_line_products, (planes, lines, unit))


@READS
def test_positions_have_gradients_where_they_need_them(read, kernels: str):
    planes, lines = factors(4, 8)
    unit = ((torch.randint(0, 3, (9, 3)) + 0.2 + 0.6 * torch.rand(9, 3)) / 3).requires_grad_()
    (got,) = torch.autograd.grad(read(planes, lines, unit).sum(), unit)
    double = unit.detach().double().requires_grad_()
    products = plane_line_products(planes.double(), lines.double(), double)
    (wanted,) = torch.autograd.grad(products.sum(), double)
    torch.testing.assert_close(got.double(), wanted, rtol=1e-4, atol=1e-4)


@SIZES
def test_products_sampled_as_pictures_are_the_same(side: int, channels: int):
    planes, lines = (x.requires_grad_() for x in factors(side, channels, torch.float64))
    unit = (1.4 * torch.rand(50, 3, dtype=torch.float64) - 0.2).requires_grad_()
    got, expected = sampled_products(planes, lines, unit).flatten(1), plane_line_products(planes, lines, unit)
    torch.testing.assert_close(got, expected)
    above = torch.randn_like(expected)
    gradients = (torch.autograd.grad(out, (planes, lines, unit), above) for out in (got, expected))
    torch.testing.assert_close(*gradients)
    bad = torch.tensor([[0.5, NAN, 0.5], [0.5, 0.5, 0.5]], dtype=torch.float64)
    assert sampled_products(planes, lines, bad).isnan().flatten(1).all(1).tolist() == [True, False]


@READS
def test_a_position_that_is_not_a_number_shows(read, kernels: str):
    planes, lines = (x.requires_grad_() for x in factors(5, 8))
    unit = torch.rand(10, 3)
    unit[3, 0], unit[5, 2], unit[7] = NAN, NAN, NAN
    values = read(planes, lines, unit).view(10, -1)
    bad = unit.isnan().any(1)
    assert values[bad].isnan().all() and values[~bad].isfinite().all()
    values.sum().backward()
    assert planes.grad.isnan().any() and lines.grad.isnan().any()


def test_a_vertex_that_is_not_a_number_shows(kernels: str):
    (planes, lines), unit = factors(2, 8), 0.1 + 0.8 * torch.rand(20, 3)
    planes[1, 0, 1, 3] = NAN
    lines[2, 1, 5] = NAN
    products = plane_line_products(planes, lines, unit)
    bad = products.isnan().all(0)
    assert bad.nonzero().flatten().tolist() == [8 + 3, 16 + 5] and products[:, ~bad].isfinite().all()
