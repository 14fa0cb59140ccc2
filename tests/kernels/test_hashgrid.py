import itertools
import math

import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import hash_interpolate, use_kernels
from tests.helpers.assert_close import assert_agrees

NAN = float("nan")
CASES = {
    "dense, full": ([(3, 3, 3)], [64]),
    "dense, with room": ([(2, 2, 2)], [32]),
    "hashed, nearly fitting": ([(3, 3, 3)], [32]),
    "hashed, products beyond 32 bits": ([(1500, 1500, 1500)], [2**14]),
    "dense and hashed": ([(1, 1, 1), (5, 5, 5), (9, 9, 9)], [8, 216, 64]),
    "sides that differ": ([(1, 4, 2), (5, 3, 8)], [30, 64]),
    "2D, dense, full": ([(3, 2)], [12]),
    "2D, dense, with room": ([(2, 5)], [32]),
    "2D, hashed, nearly fitting": ([(3, 2)], [8]),
    "2D, hashed, products beyond 32 bits": ([(1500, 2000)], [2**14]),
    "2D, dense and hashed": ([(1, 2), (5, 3), (11, 20)], [6, 24, 64]),
}
"""Each level's cells along every axis, and the entries of its table."""
LEVELS = pytest.mark.parametrize(("cells", "sizes"), CASES.values(), ids=CASES)
Levels = list[tuple[int, ...]]


def entry(corner: list[int], cells: tuple[int, ...], size: int) -> int:
    """Instant-NGP, eq. 4, in whole numbers without bounds; row by row where all corners fit."""
    if math.prod(side + 1 for side in cells) <= size:
        return sum(place * math.prod(side + 1 for side in cells[:axis]) for axis, place in enumerate(corner))
    hashed = 0
    for place, prime in zip(corner, (1, 2654435761, 805459861), strict=False):
        hashed ^= place * prime
    return hashed % 2**32 % size


def by_hand(tables: Tensor, unit: Tensor, resolutions: Levels, sizes: list[int]) -> Tensor:
    """Every level's corners one by one."""
    rows = []
    for point in unit.double().clamp(0, 1).tolist():
        row, start = [], 0
        for cells, size in zip(resolutions, sizes, strict=True):
            low = [min(int(p * side), side - 1) for p, side in zip(point, cells, strict=True)]
            share = [p * side - c for p, side, c in zip(point, cells, low, strict=True)]
            total = torch.zeros(tables.shape[1], dtype=torch.float64)
            for bits in itertools.product((0, 1), repeat=len(cells)):
                weight = math.prod(f if bit else 1 - f for bit, f in zip(bits, share, strict=True))
                corner = [c + bit for c, bit in zip(low, bits, strict=True)]
                total += weight * tables[start + entry(corner, cells, size)]
            row.append(total)
            start += size
        rows.append(torch.cat(row))
    return torch.stack(rows)


def inside_cells(count: int, cells: tuple[int, ...]) -> Tensor:
    """Places away from the borders of cells, where the slope jumps."""
    corner = torch.stack([torch.randint(0, side, (count,)) for side in cells], dim=1)
    return (corner + 0.2 + 0.6 * torch.rand(count, len(cells))) / torch.tensor(cells)


@LEVELS
def test_interpolation_agrees_with_a_loop_over_corners(cells: Levels, sizes: list[int]):
    tables, axes = torch.randn(sum(sizes), 2, dtype=torch.float64), len(cells[0])
    ends = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0.5], [1, 0.25, 0], [-0.3, 0.5, 1.2]])
    unit = torch.cat([torch.rand(20, 3), ends])[:, :axes]
    expected = by_hand(tables, unit, cells, sizes)
    torch.testing.assert_close(hash_interpolate(tables, unit.double(), cells, sizes), expected, atol=1e-9, rtol=1e-9)
    for choice in ("auto", "reference"):
        use_kernels(choice)
        single = hash_interpolate(tables.float(), unit, cells, sizes)
        torch.testing.assert_close(single.double(), expected, atol=1e-5 + 1e-6 * max(max(cells)), rtol=0)


@LEVELS
def test_features_are_continuous_across_cells(cells: Levels, sizes: list[int], kernels: str):
    tables, axes = torch.randn(sum(sizes), 2), len(cells[0])
    for level in cells:
        border = torch.rand(20 * axes, axes)
        for axis, side in enumerate(level):
            if side > 1:
                border[20 * axis : 20 * axis + 20, axis] = torch.randint(1, side, (20,)) / side
        nudge = 1e-6 * torch.eye(axes).repeat_interleave(20, 0)
        before, after = (hash_interpolate(tables, border + s * nudge, cells, sizes) for s in (-1, 1))
        torch.testing.assert_close(before, after, atol=0.05, rtol=0)


@LEVELS
def test_positions_outside_are_clamped_and_transposed_ones_read_alike(cells: Levels, sizes: list[int], kernels: str):
    tables, unit = torch.randn(sum(sizes), 2), torch.randn(len(cells[0]), 50) * 3
    inside = hash_interpolate(tables, unit.T.contiguous().clamp(0, 1), cells, sizes)
    assert torch.equal(hash_interpolate(tables, unit.T, cells, sizes), inside)


@pytest.mark.parametrize("cells", [(5, 5, 5), (3, 5, 4), (5, 8)])
def test_a_dense_level_reproduces_linear_functions(cells: tuple[int, ...], kernels: str):
    sides = [torch.arange(side + 1) / side for side in cells]
    places = torch.cartesian_prod(*reversed(sides)).flip(1)  # the first axis fastest
    slopes = torch.randn(len(cells), 2)
    tables, unit = places @ slopes + 0.1, torch.rand(200, len(cells))
    actual = hash_interpolate(tables, unit, [cells], [len(tables)])
    torch.testing.assert_close(actual, unit @ slopes + 0.1, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    ("cells", "sizes"),
    [([(2, 2, 2)], [27]), ([(4, 4, 4)], [8]), ([(1, 1, 1), (3, 3, 3)], [8, 16]), ([(1, 2), (4, 2)], [6, 8])],
)
def test_gradients_of_tables_and_positions(cells: Levels, sizes: list[int], kernels: str):
    """In single precision too, where the fast version answers."""
    tables = torch.randn(sum(sizes), 2, dtype=torch.float64, requires_grad=True)
    unit = inside_cells(5, tuple(math.lcm(*sides) for sides in zip(*cells, strict=True))).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda t, u: hash_interpolate(t, u, cells, sizes), (tables, unit))
    above = torch.randn(5, 2 * len(sizes))
    double, single = (
        torch.autograd.grad((hash_interpolate(*inputs, cells, sizes) * above).sum(), inputs)
        for inputs in ((tables, unit), [x.detach().float().requires_grad_() for x in (tables, unit)])
    )
    for got, wanted in zip(single, double, strict=True):
        torch.testing.assert_close(got.double(), wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("samples", [0, 1, 2000])
@pytest.mark.parametrize(("cells", "sizes"), [*CASES.values(), ([(n,) * 3 for n in (2, 4, 7, 12, 20)], [32] * 5)])
def test_interpolation_agrees_with_the_reference(cells: Levels, sizes: list[int], samples: int):
    tables, unit = torch.randn(sum(sizes), 2), 1.2 * torch.rand(samples, len(cells[0])) - 0.1
    assert_agrees(lambda t, u: hash_interpolate(t, u, cells, sizes), [tables, unit], atol=3e-6)


def test_entries_may_hold_another_number_of_features():
    cells, sizes = CASES["2D, dense and hashed"]
    inputs = [torch.randn(sum(sizes), 4), torch.rand(300, 2)]
    assert_agrees(lambda t, u: hash_interpolate(t, u, cells, sizes), inputs, constants=(1,))


@LEVELS
def test_a_position_that_is_not_a_number_shows(cells: Levels, sizes: list[int], kernels: str):
    tables, unit = torch.randn(sum(sizes), 2, requires_grad=True), torch.rand(10, len(cells[0]))
    unit[3, 0], unit[5, -1], unit[7] = NAN, NAN, NAN
    features = hash_interpolate(tables, unit, cells, sizes)
    assert features.isnan().all(1).tolist() == unit.isnan().any(1).tolist()
    assert features.isnan().any(1).tolist() == unit.isnan().any(1).tolist(), "and nowhere else"
    features.sum().backward()
    assert tables.grad.isnan().any()


@pytest.mark.parametrize("axes", [2, 3])
def test_an_entry_that_is_not_a_number_shows(axes: int, kernels: str):
    tables = torch.randn(2**axes, 2)
    tables[3, 1] = NAN
    features = hash_interpolate(tables, 0.1 + 0.8 * torch.rand(10, axes), [(1,) * axes], [2**axes])
    assert features[:, 1].isnan().all() and features[:, 0].isfinite().all()
