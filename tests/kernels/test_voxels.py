import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import (
    spherical_harmonics,
    touch_rows,
    use_kernels,
    voxel_colour,
    voxel_colour_reference,
    voxel_value,
    voxel_values_reference,
)

SIDE = 6


def sparse_index(side: int = SIDE) -> Tensor:
    """Rows of a grid's vertices, a third of which are not kept."""
    kept = torch.rand(side**3) > 1 / 3
    return torch.where(kept, kept.cumsum(0), 0).int()


def places(count: int) -> Tensor:
    """Positions within the unit cube, on its faces and outside."""
    return torch.cat([torch.rand(count, 3), torch.tensor([[0.0, 0, 0], [1, 1, 1], [-0.5, 0.3, 2]])])


def by_hand(values: Tensor, index: Tensor, position: list[float]) -> float:
    cells, total = SIDE - 1, 0.0
    scaled = [min(max(p, 0.0), 1.0) * cells for p in position]
    low = [min(int(s), cells - 1) for s in scaled]
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                weight = 1.0
                for bit, s, c in zip((i, j, k), scaled, low, strict=True):
                    weight *= s - c if bit else 1 - (s - c)
                row = index[((low[0] + i) * SIDE + low[1] + j) * SIDE + low[2] + k]
                total += weight * float(values[row])
    return total


@pytest.mark.parametrize("choice", ["auto", "reference"])
def test_value_agrees_with_a_loop_over_vertices(choice):
    index, unit = sparse_index(), places(20)
    values = torch.randn(int(index.max()) + 1)
    use_kernels(choice)
    try:
        actual = voxel_value(values, index, unit)
    finally:
        use_kernels("auto")
    expected = torch.tensor([by_hand(values, index, position) for position in unit.tolist()])
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_fast_value_agrees_with_the_reference_in_value_and_gradient(count):
    index, unit = sparse_index(), places(count)
    values = torch.randn(int(index.max()) + 1, requires_grad=True)
    above = torch.randn(len(unit))
    fast, plain = voxel_value(values, index, unit), voxel_values_reference(values, index, unit)
    torch.testing.assert_close(fast, plain, atol=1e-5, rtol=1e-5)
    (ours,) = torch.autograd.grad(fast, values, above)
    (theirs,) = torch.autograd.grad(plain, values, above)
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-5)
    assert ours[0] == 0  # the row of all vertices that are not kept is a constant
    assert ours[1:].any()


@pytest.mark.parametrize("terms", [1, 4, 9, 16])
def test_fast_colour_agrees_with_the_reference_in_value_and_gradient(terms):
    index, unit = sparse_index(), places(300)
    values = torch.randn(int(index.max()) + 1, 3 * terms, requires_grad=True)
    directions = torch.nn.functional.normalize(torch.randn(len(unit), 3), dim=1)
    basis, above = spherical_harmonics(directions)[:, :terms], torch.randn(len(unit), 3)
    fast, plain = (f(values, index, unit, basis) for f in (voxel_colour, voxel_colour_reference))
    torch.testing.assert_close(fast, plain, atol=1e-5, rtol=1e-4)
    (ours,) = torch.autograd.grad(fast, values, above)
    (theirs,) = torch.autograd.grad(plain, values, above)
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-4)
    assert not ours[0].any()
    (again,) = torch.autograd.grad(voxel_colour(values, index, unit, basis), values, above)
    assert torch.equal(ours, again)


def test_what_is_not_a_number_stays_visible():
    index = torch.arange(1, SIDE**3 + 1, dtype=torch.int32)
    values = torch.full((SIDE**3 + 1,), float("nan"))
    assert voxel_value(values, index, places(3)).isnan().all()
    values, nowhere = torch.ones(SIDE**3 + 1), torch.full((2, 3), float("nan"))
    assert voxel_value(values, index, nowhere).isnan().all()
    assert voxel_values_reference(values, index, nowhere).isnan().all()


@pytest.mark.parametrize("choice", ["auto", "reference"])
def test_touching_marks_the_rows_that_are_read(choice):
    index = torch.arange(1, SIDE**3 + 1, dtype=torch.int32)
    touched = torch.zeros(SIDE**3 + 1, dtype=torch.bool)
    use_kernels(choice)
    try:
        touch_rows(touched, index, torch.tensor([[0.05, 0.05, 0.05]]))
    finally:
        use_kernels("auto")
    near = [(i * SIDE + j) * SIDE + k + 1 for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    assert touched.nonzero()[:, 0].tolist() == near
