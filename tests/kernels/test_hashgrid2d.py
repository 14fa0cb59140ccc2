import jaxtyping
import pytest
import torch
from agreement import agree, outcome, with_threads
from torch import Tensor

from nerf_lightning.kernels import hash_interpolate_2d, use_kernels

NAN = float("nan")
LEVELS = pytest.mark.parametrize(
    ("resolutions", "sizes"),
    [
        pytest.param([(3, 2)], [12], id="dense, full"),
        pytest.param([(2, 5)], [32], id="dense, with room"),
        pytest.param([(3, 2)], [8], id="hashed, nearly fitting"),
        pytest.param([(4, 9)], [16], id="hashed"),
        pytest.param([(1500, 2000)], [2**14], id="hashed, products beyond 32 bits"),
        pytest.param([(1, 2), (5, 3), (11, 20)], [6, 24, 64], id="dense and hashed"),
    ],
)


def entry(x: int, y: int, resolution: tuple[int, int], size: int) -> int:
    """Instant-NGP, eq. 4, in whole numbers without bounds; row by row where all corners fit."""
    across, down = (cells + 1 for cells in resolution)
    return x + across * y if across * down <= size else (x ^ (y * 2654435761)) % 2**32 % size


def by_hand(tables: Tensor, unit: Tensor, resolutions: list[tuple[int, int]], sizes: list[int]) -> Tensor:
    """Every level's corners one by one."""
    rows = []
    for place in unit.double().clamp(0, 1).tolist():
        row, start = [], 0
        for resolution, size in zip(resolutions, sizes, strict=True):
            scaled = [p * cells for p, cells in zip(place, resolution, strict=True)]
            x, y = (min(int(s), cells - 1) for s, cells in zip(scaled, resolution, strict=True))
            fx, fy = scaled[0] - x, scaled[1] - y
            corners = {(0, 0): (1 - fx) * (1 - fy), (1, 0): fx * (1 - fy), (0, 1): (1 - fx) * fy, (1, 1): fx * fy}
            row.append(sum(w * tables[start + entry(x + i, y + j, resolution, size)] for (i, j), w in corners.items()))
            start += size
        rows.append(torch.cat(row))
    return torch.stack(rows)


def within(count: int, cells: int = 1) -> Tensor:
    """Places well inside the cells of a grid, along whose borders the slope jumps."""
    return (torch.randint(0, cells, (count, 2)) + 0.2 + 0.6 * torch.rand(count, 2)) / cells


@LEVELS
def test_interpolation_agrees_with_a_loop_over_corners(resolutions, sizes):
    tables = torch.randn(sum(sizes), 2, dtype=torch.float64)
    ends = torch.tensor([[0.0, 0], [1, 1], [0, 1], [1, 0.25], [0.75, 1], [-0.3, 0.5], [0.1, 1.2]])
    unit = torch.cat([torch.rand(40, 2), ends])
    expected = by_hand(tables, unit, resolutions, sizes)
    double = hash_interpolate_2d(tables, unit.double(), resolutions, sizes)
    torch.testing.assert_close(double, expected, atol=1e-9, rtol=1e-9)
    finest = max(max(resolution) for resolution in resolutions)
    for choice in ("auto", "reference"):
        use_kernels(choice)
        single = hash_interpolate_2d(tables.float(), unit, resolutions, sizes)
        torch.testing.assert_close(single.double(), expected, atol=1e-5 + 1e-6 * finest, rtol=0)


@LEVELS
@pytest.mark.parametrize("samples", [0, 1, 7, 2000])
def test_interpolation_agrees_with_the_reference(resolutions, sizes, samples: int):
    tables, unit = torch.randn(sum(sizes), 2), 1.2 * torch.rand(samples, 2) - 0.1
    agree(lambda t, u: hash_interpolate_2d(t, u, resolutions, sizes), [tables, unit], constants=(1,), atol=3e-6)


def test_entries_may_hold_another_number_of_features():
    tables, unit = torch.randn(12 + 16, 3), torch.rand(300, 2)
    agree(lambda t, u: hash_interpolate_2d(t, u, [(3, 2), (5, 9)], [12, 16]), [tables, unit], constants=(1,))


@LEVELS
def test_features_are_continuous_across_cells(resolutions, sizes, kernels: str):
    tables = torch.randn(sum(sizes), 2)
    for across, down in resolutions:
        border = torch.rand(40, 2)
        if across > 1:
            border[:20, 0] = torch.randint(1, across, (20,)) / across
        border[20:, 1] = torch.randint(1, down, (20,)) / down
        step = 1e-6 * torch.eye(2).repeat_interleave(20, 0)
        before, after = (hash_interpolate_2d(tables, border + s * step, resolutions, sizes) for s in (-1, 1))
        torch.testing.assert_close(before, after, atol=0.05, rtol=0)


def test_places_outside_are_clamped(kernels: str):
    resolutions, sizes = [(3, 2), (4, 9)], [12, 16]
    tables, unit = torch.randn(28, 2), torch.randn(50, 2) * 3
    inside = hash_interpolate_2d(tables, unit.clamp(0, 1), resolutions, sizes)
    assert torch.equal(hash_interpolate_2d(tables, unit, resolutions, sizes), inside)


def test_a_dense_level_reproduces_linear_functions(kernels: str):
    across, down = 5, 8
    y, x = torch.meshgrid(torch.arange(down + 1) / down, torch.arange(across + 1) / across, indexing="ij")
    slopes = torch.tensor([[2.0, -3.0], [-1.0, 0.5]])
    tables = torch.stack([x, y], dim=-1).view(-1, 2) @ slopes.T + 0.1
    unit = torch.rand(200, 2)
    actual = hash_interpolate_2d(tables, unit, [(across, down)], [len(tables)])
    torch.testing.assert_close(actual, unit @ slopes.T + 0.1, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("resolutions", "sizes"), [([(2, 4)], [15]), ([(4, 2)], [8]), ([(1, 2), (4, 2)], [6, 8])])
def test_gradients_of_tables_and_places(resolutions, sizes):
    tables = torch.randn(sum(sizes), 2, dtype=torch.float64, requires_grad=True)
    unit = within(6, cells=4).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda t, u: hash_interpolate_2d(t, u, resolutions, sizes), (tables, unit))


def test_places_have_gradients_where_they_need_them(kernels: str):
    """The fast version has none: it must leave such places to the reference."""
    tables, unit = torch.randn(9, 2, requires_grad=True), within(9, cells=2).requires_grad_()
    above = torch.randn(9, 2)
    inputs = [(tables, unit), [x.detach().double().requires_grad_() for x in (tables, unit)]]
    single, double = (
        torch.autograd.grad((hash_interpolate_2d(*pair, [(2, 2)], [9]) * above).sum(), pair) for pair in inputs
    )
    for got, wanted in zip(single, double, strict=True):
        torch.testing.assert_close(got.double(), wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("resolutions", "sizes"), [([(5, 9)], [16]), ([(1, 2), (5, 3), (11, 20)], [6, 24, 64])])
def test_interpolation_gives_the_same_with_any_number_of_threads(resolutions, sizes):
    inputs = [torch.randn(sum(sizes), 2), torch.rand(3001, 2)]
    one, two = (
        with_threads(lambda: outcome(lambda t, u: hash_interpolate_2d(t, u, resolutions, sizes), inputs, (1,)), threads)
        for threads in (1, 2)
    )
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True)), "levels do not share sums"


@pytest.mark.parametrize(("resolutions", "sizes"), [([(3, 2)], [12]), ([(4, 9)], [16]), ([(3, 2), (4, 9)], [12, 16])])
def test_a_place_that_is_not_a_number_shows(resolutions, sizes, kernels: str):
    tables, unit = torch.randn(sum(sizes), 2, requires_grad=True), torch.rand(10, 2)
    unit[3, 0], unit[5, 1], unit[7] = NAN, NAN, NAN
    features = hash_interpolate_2d(tables, unit, resolutions, sizes)
    assert features.isnan().all(1).tolist() == unit.isnan().any(1).tolist()
    assert features.isnan().any(1).tolist() == unit.isnan().any(1).tolist(), "and nowhere else"
    features.sum().backward()
    assert tables.grad.isnan().any()


def test_an_entry_that_is_not_a_number_shows(kernels: str):
    tables = torch.randn(4, 2)
    tables[3, 1] = NAN
    features = hash_interpolate_2d(tables, within(10), [(1, 1)], [4])
    assert features[:, 1].isnan().all() and features[:, 0].isfinite().all()


def test_transposed_places_are_read_alike(kernels: str):
    tables, unit = torch.randn(16, 2), torch.rand(2, 100)
    copied = hash_interpolate_2d(tables, unit.T.contiguous(), [(4, 9)], [16])
    assert torch.equal(hash_interpolate_2d(tables, unit.T, [(4, 9)], [16]), copied)


def test_places_of_three_coordinates_are_refused_in_tests():
    with pytest.raises(jaxtyping.TypeCheckError):
        hash_interpolate_2d(torch.zeros(9, 2), torch.rand(4, 3), [(2, 2)], [9])
