import jaxtyping
import pytest
import torch
from agreement import agree, outcome, with_threads
from torch import Tensor

from nerf_lightning.kernels import hash_interpolate, use_kernels

NAN = float("nan")


LEVELS = [
    pytest.param([3], [64], id="dense, full"),
    pytest.param([4], [128], id="dense, with room"),
    pytest.param([9], [32], id="hashed"),
    pytest.param([1500], [2**14], id="hashed, products beyond 32 bits"),
    pytest.param([2, 5, 11], [27, 216, 64], id="dense and hashed"),
]


def entry(x: int, y: int, z: int, resolution: int, size: int) -> int:
    """Instant-NGP, eq. 4, in whole numbers without bounds; row by row where all corners fit."""
    side = resolution + 1
    if side**3 <= size:
        return x + side * y + side * side * z
    return ((x * 1) ^ (y * 2654435761) ^ (z * 805459861)) % 2**32 % size


def by_hand(tables: Tensor, unit: Tensor, resolutions: list[int], sizes: list[int]) -> Tensor:
    rows = []
    for point in unit.double().clamp(0, 1).tolist():
        features, start = [], 0
        for resolution, size in zip(resolutions, sizes, strict=True):
            low = [min(int(p * resolution), resolution - 1) for p in point]
            share = [p * resolution - c for p, c in zip(point, low, strict=True)]
            total = torch.zeros(tables.shape[1], dtype=torch.float64)
            for i in (0, 1):
                for j in (0, 1):
                    for k in (0, 1):
                        weight = 1.0
                        for bit, f in zip((i, j, k), share, strict=True):
                            weight *= f if bit else 1 - f
                        total += weight * tables[start + entry(low[0] + i, low[1] + j, low[2] + k, resolution, size)]
            features += total.tolist()
            start += size
        rows.append(features)
    return torch.tensor(rows, dtype=torch.float64)


@pytest.mark.parametrize(("resolutions", "sizes"), LEVELS)
def test_interpolation_agrees_with_a_loop_over_corners(resolutions, sizes):
    tables = torch.randn(sum(sizes), 2, dtype=torch.float64)
    corner_cases = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0.5], [1, 0.25, 0]])
    unit = torch.cat([torch.rand(40, 3), corner_cases])
    expected = by_hand(tables, unit, resolutions, sizes)
    double = hash_interpolate(tables, unit.double(), resolutions, sizes)
    torch.testing.assert_close(double, expected, atol=1e-9, rtol=1e-9)
    for choice in ("auto", "reference"):
        use_kernels(choice)
        single = hash_interpolate(tables.float(), unit, resolutions, sizes)
        torch.testing.assert_close(single.double(), expected, atol=1e-5 + 1e-6 * max(resolutions), rtol=0)


@pytest.mark.parametrize(("dtype", "step", "jump"), [(torch.float64, 1e-9, 1e-4), (torch.float32, 1e-6, 0.05)])
@pytest.mark.parametrize(("resolutions", "sizes"), LEVELS)
def test_features_are_continuous_across_cells(resolutions, sizes, dtype, step, jump):
    tables = torch.randn(sum(sizes), 2, dtype=dtype)
    for resolution in resolutions:
        border = torch.rand(60, 3, dtype=dtype)
        border[:20, 0] = border[20:40, 1] = border[40:, 2] = torch.randint(1, resolution, (20,)).to(dtype) / resolution
        nudge = step * torch.eye(3, dtype=dtype).repeat_interleave(20, 0)
        before, after = (hash_interpolate(tables, border + s * nudge, resolutions, sizes) for s in (-1, 1))
        torch.testing.assert_close(before, after, atol=jump, rtol=0)


def test_positions_outside_are_clamped(kernels: str):
    resolutions, sizes = [3, 9], [64, 32]
    tables, unit = torch.randn(96, 2), torch.randn(50, 3) * 3
    inside = hash_interpolate(tables, unit.clamp(0, 1), resolutions, sizes)
    assert torch.equal(hash_interpolate(tables, unit, resolutions, sizes), inside)


def test_a_dense_level_reproduces_linear_functions(kernels: str):
    resolution = 5
    side = torch.arange(resolution + 1) / resolution
    z, y, x = torch.meshgrid(side, side, side, indexing="ij")
    slopes = torch.tensor([[2.0, -3.0, 0.7], [-1.0, 0.5, 4.0]])
    tables = torch.stack([x, y, z], dim=-1).view(-1, 3) @ slopes.T + 0.1
    unit = torch.rand(200, 3)
    actual = hash_interpolate(tables, unit, [resolution], [len(tables)])
    torch.testing.assert_close(actual, unit @ slopes.T + 0.1, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("resolutions", "sizes"), [([2], [27]), ([4], [8]), ([1, 3], [8, 16])])
def test_gradients_of_tables_and_positions(resolutions, sizes):
    tables = torch.randn(sum(sizes), 2, dtype=torch.float64, requires_grad=True)
    # Away from the borders, where the slope jumps.
    unit = ((torch.randint(0, 12, (5, 3)) + 0.2 + 0.6 * torch.rand(5, 3)) / 12).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda t, u: hash_interpolate(t, u, resolutions, sizes), (tables, unit))


@pytest.mark.parametrize(
    ("resolutions", "sizes"), [*((p.values[0], p.values[1]) for p in LEVELS), ([2, 4, 7, 12, 20], [32] * 5)]
)
@pytest.mark.parametrize("samples", [0, 1, 7, 2000])
def test_interpolation_agrees_with_the_reference(resolutions, sizes, samples: int):
    tables, unit = torch.randn(sum(sizes), 2), 1.2 * torch.rand(samples, 3) - 0.1
    agree(lambda t, u: hash_interpolate(t, u, resolutions, sizes), [tables, unit], constants=(1,), atol=3e-6)


def test_entries_may_hold_another_number_of_features():
    tables, unit = torch.randn(27 + 64, 4), torch.rand(300, 3)
    agree(lambda t, u: hash_interpolate(t, u, [2, 9], [27, 64]), [tables, unit], constants=(1,))


def test_transposed_positions_are_read_alike(kernels: str):
    tables, unit = torch.randn(64, 2), torch.rand(3, 100)
    copied = hash_interpolate(tables, unit.T.contiguous(), [9], [64])
    assert torch.equal(hash_interpolate(tables, unit.T, [9], [64]), copied)


def test_positions_have_gradients_where_they_need_them(kernels: str):
    tables = torch.randn(27, 2, requires_grad=True)
    unit = ((torch.randint(0, 2, (9, 3)) + 0.2 + 0.6 * torch.rand(9, 3)) / 2).requires_grad_()
    above = torch.randn(9, 2)
    gradients = torch.autograd.grad((hash_interpolate(tables, unit, [2], [27]) * above).sum(), (tables, unit))
    double = [x.detach().double().requires_grad_() for x in (tables, unit)]
    expected = torch.autograd.grad((hash_interpolate(*double, [2], [27]) * above).sum(), double)
    for got, wanted in zip(gradients, expected, strict=True):
        torch.testing.assert_close(got.double(), wanted, rtol=1e-4, atol=1e-5)


def test_interpolation_gives_the_same_with_any_number_of_threads():
    resolutions, sizes = [2, 5, 11], [27, 216, 64]
    inputs = [torch.randn(sum(sizes), 2), torch.rand(3001, 3)]
    one, two = (
        with_threads(lambda: outcome(lambda t, u: hash_interpolate(t, u, resolutions, sizes), inputs, (1,)), threads)
        for threads in (1, 2)
    )
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True)), "levels do not share sums"


@pytest.mark.parametrize(("resolutions", "sizes"), [([3], [64]), ([9], [32]), ([3, 9], [64, 32])])
def test_a_position_that_is_not_a_number_shows(resolutions, sizes, kernels: str):
    tables, unit = torch.randn(sum(sizes), 2, requires_grad=True), torch.rand(10, 3)
    unit[3, 0], unit[5, 2], unit[7] = NAN, NAN, NAN
    features = hash_interpolate(tables, unit, resolutions, sizes)
    assert features.isnan().all(1).tolist() == unit.isnan().any(1).tolist()
    assert features.isnan().any(1).tolist() == unit.isnan().any(1).tolist(), "and nowhere else"
    features.sum().backward()
    assert tables.grad.isnan().any()


def test_an_entry_that_is_not_a_number_shows(kernels: str):
    tables, unit = torch.randn(8, 2), 0.1 + 0.8 * torch.rand(10, 3)
    tables[3, 1] = NAN
    features = hash_interpolate(tables, unit, [1], [8])
    assert features[:, 1].isnan().all() and features[:, 0].isfinite().all()


def test_a_wrong_shape_is_refused_in_tests():
    with pytest.raises(jaxtyping.TypeCheckError):
        hash_interpolate(torch.zeros(27, 2), torch.rand(4, 2), [2], [27])
