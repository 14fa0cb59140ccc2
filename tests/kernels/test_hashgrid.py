import itertools
import math

import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import hash_interpolate, set_kernels

CASES = {
    "dense, with room": ([(2, 2, 2)], [32]),
    "hashed, products beyond 32 bits": ([(1500, 1500, 1500)], [2**14]),
    "dense and hashed": ([(1, 1, 1), (5, 5, 5), (9, 9, 9)], [8, 216, 64]),
    "sides that differ": ([(1, 4, 2), (5, 3, 8)], [30, 64]),
    "2D, dense, with room": ([(2, 5)], [32]),
    "2D, dense and hashed": ([(1, 2), (5, 3), (11, 20)], [6, 24, 64]),
}
"""Each level's cells along every axis, and the entries of its table."""
LEVELS = pytest.mark.parametrize(("cells", "sizes"), CASES.values(), ids=CASES)
Levels = list[tuple[int, ...]]


def entry(corner: list[int], cells: tuple[int, ...], size: int) -> int:
    """Entry index by Instant-NGP, eq. 4, in unbounded integers; row-major where dense."""
    if math.prod(side + 1 for side in cells) <= size:
        return sum(coordinate * math.prod(side + 1 for side in cells[:axis]) for axis, coordinate in enumerate(corner))
    hashed = 0
    for coordinate, prime in zip(corner, (1, 2654435761, 805459861), strict=False):
        hashed ^= coordinate * prime
    return hashed % 2**32 % size


def brute_force(tables: Tensor, unit: Tensor, resolutions: Levels, sizes: list[int]) -> Tensor:
    """Every level's corners one by one."""
    rows = []
    for point in unit.double().clamp(0, 1).tolist():
        row, start = [], 0
        for cells, size in zip(resolutions, sizes, strict=True):
            low = [min(int(p * side), side - 1) for p, side in zip(point, cells, strict=True)]
            fraction = [p * side - c for p, side, c in zip(point, cells, low, strict=True)]
            total = torch.zeros(tables.shape[1], dtype=torch.float64)
            for bits in itertools.product((0, 1), repeat=len(cells)):
                weight = math.prod(f if bit else 1 - f for bit, f in zip(bits, fraction, strict=True))
                corner = [c + bit for c, bit in zip(low, bits, strict=True)]
                total += weight * tables[start + entry(corner, cells, size)]
            row.append(total)
            start += size
        rows.append(torch.cat(row))
    return torch.stack(rows)


@LEVELS
def test_hash_interpolate_any_levels_match_loop_over_corners(cells: Levels, sizes: list[int]):
    tables, axes = torch.randn(sum(sizes), 2, dtype=torch.float64), len(cells[0])
    ends = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0.5], [1, 0.25, 0], [-0.3, 0.5, 1.2]])
    unit = torch.cat([torch.rand(20, 3), ends])[:, :axes]
    expected = brute_force(tables, unit, cells, sizes)
    torch.testing.assert_close(hash_interpolate(tables, unit.double(), cells, sizes), expected, atol=1e-9, rtol=1e-9)
    for choice in ("auto", "reference"):
        set_kernels(choice)
        single = hash_interpolate(tables.float(), unit, cells, sizes)
        torch.testing.assert_close(single.double(), expected, atol=1e-5 + 1e-6 * max(max(cells)), rtol=0)
