"""Fast kernels match their PyTorch references in values and gradients for any input."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning import kernels as k
from nerf_lightning.cameras import Bounds, Rays
from tests.helpers.kernel_comparison import assert_matches_reference, values_and_gradients
from tests.helpers.ragged_samples import BUNDLE, make_ragged_samples

DRAW = Callable[[st.SearchStrategy], object]
SAMPLES = st.sampled_from([0, 1, 2, 128, 700])
"""Numbers of samples: none, one, and more than one block of a kernel."""
COUNTS = st.one_of(st.lists(st.integers(0, 7), max_size=6), st.just(BUNDLE))
"""Samples per ray."""
UNBOUNDED = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
HASH_GRIDS = [
    *(([(3, 3, 3)], [64]), ([(2, 2, 2)], [32]), ([(1500, 1500, 1500)], [2**14]), ([(1, 4, 2), (5, 3, 8)], [30, 64])),
    *(([(n,) * 3 for n in (2, 4, 7, 12, 20)], [32] * 5), ([(3, 2)], [12]), ([(1, 2), (5, 3), (11, 20)], [6, 24, 64])),
]
"""Cells and table sizes: dense, dense with unused entries, hashed beyond 32 bits, non-cubic, many levels, and 2D."""
WIDTHS = [(4, 4), (3, 5), (16, 32, 16), (1, 1, 1), (5, 31, 3, 7), (12, 32, 32, 31, 3)]
"""Widths of input, hidden layers and output: one to four layers, with and without padding to fours."""


@dataclass
class Case:
    call: Callable[..., object]
    inputs: list[Tensor]
    constants: tuple[int, ...] = ()
    """Indices of inputs without a gradient."""
    rtol: float = 1e-4
    atol: float = 1e-6
    same_with_any_threads: bool = True
    spoilt: int | None = None
    """Index of the input whose NaN must propagate."""


def packed(counts: list[int]) -> tuple[Tensor, ...]:
    samples = make_ragged_samples(counts)
    return samples.t, samples.dt, samples.ray, samples.offsets


def directions(count: int) -> Tensor:
    return normalize(torch.randn(count, 3), dim=1)


def composite(draw: DRAW) -> Case:
    """Fields give densities as a column, colors as the transpose of [3, N]."""
    t, dt, ray, offsets = packed(draw(COUNTS))
    density = draw(st.sampled_from([0.1, 3.0, 100.0])) * torch.rand(len(t), 2) * (torch.rand(len(t), 2) < 0.7)
    call = lambda d, rgb: k.composite(d[:, 1], rgb.T, t, dt, ray, offsets)  # noqa: E731
    return Case(call, [density, torch.rand(3, len(t))], spoilt=1)


def filter_visible(draw: DRAW) -> Case:
    given = packed(draw(COUNTS))
    optical_depth = 30 * torch.rand(len(given[0])) * (torch.rand(len(given[0])) < 0.5) * given[1]
    least, max_dropped = draw(st.sampled_from([(0.0, math.inf), (0.1, math.inf), (0.1, 0.2)]))

    def call() -> list[Tensor]:
        kept, which, _ = k.filter_visible(optical_depth, given, 1e-3, least, max_dropped=max_dropped)
        return [kept, *which]

    return Case(call, [], rtol=0, atol=0)


def median_depth(draw: DRAW) -> Case:
    given = packed(draw(COUNTS))
    density = 5 * torch.sin(7 * given[0]) ** 2
    opacity = k.composite(density, torch.zeros(len(density), 3), *given)[1]
    return Case(lambda: k.median_depth(density, opacity, given), [], atol=1e-5)


def merge_low_weight(draw: DRAW) -> Case:
    given = packed(draw(COUNTS))
    optical_depth = 2 * torch.rand(len(given[0])) ** 3

    def call() -> list[Tensor]:
        merged, which = k.merge_low_weight(optical_depth, given, 0.1)
        return [merged, *which]

    return Case(call, [], rtol=1.3e-6, atol=1e-5)


def spherical_harmonics(draw: DRAW) -> Case:
    transposed = draw(st.booleans())
    d = directions(draw(SAMPLES))
    call = (lambda x: k.spherical_harmonics(x.T)) if transposed else k.spherical_harmonics
    return Case(call, [d.T.contiguous() if transposed else d], draw(st.sampled_from([(), (0,)])), rtol=1e-5, spoilt=0)


def hash_interpolate(draw: DRAW) -> Case:
    cells, sizes = draw(st.sampled_from(HASH_GRIDS))
    few = len(sizes) < 3 or len(cells[0]) == 3
    features = 2 if few else draw(st.sampled_from([2, 4]))  # each number is compiled separately
    tables, unit = torch.randn(sum(sizes), features), 1.2 * torch.rand(draw(SAMPLES), len(cells[0])) - 0.1
    # Only entries of two features have a fast gradient of the positions.
    constants = (1,) if features > 2 else draw(st.sampled_from([(), (1,)]))
    return Case(lambda t, u: k.hash_interpolate(t, u, cells, sizes), [tables, unit], constants, atol=3e-6, spoilt=1)


def mlp(draw: DRAW) -> Case:
    widths, further, samples = draw(st.sampled_from(WIDTHS)), draw(st.sampled_from([0, 3])), draw(SAMPLES)
    flat: list[Tensor] = []
    for index, (i, o) in enumerate(pairwise(widths)):
        i += 0 if index else further
        flat += [torch.randn(o, i) / i**0.5, 0.3 * torch.randn(o)]
    first = draw(st.integers(0, widths[-1]))
    head = draw(st.sampled_from([slice(2), slice(1), slice(1, 2)]))  # one head alone has no gradient from the other

    def call(extra: Tensor, x: Tensor, *flat: Tensor) -> list[Tensor]:
        layers = list(zip(flat[::2], flat[1::2], strict=True))
        return list(k.mlp_heads(x.T, layers, first, extra.T if further else None)[head])

    inputs = [torch.randn(further, samples), torch.randn(widths[0], samples), *flat]
    return Case(call, inputs, (0,), atol=1e-5, same_with_any_threads=False, spoilt=1)


def planes(draw: DRAW) -> Case:
    side, channels = draw(st.sampled_from([(2, 8), (7, 8), (5, 3)]))
    read = draw(st.sampled_from([k.plane_line_products, k.plane_line_sum]))
    factors = [torch.randn(3, side, side, channels), torch.randn(3, side, channels)]
    unit = 1.2 * torch.rand(3, draw(SAMPLES)) - 0.1
    constants = draw(st.sampled_from([(), (2,)]))
    return Case(lambda p, lines, u: read(p, lines, u.T), [*factors, unit], constants, atol=3e-6, spoilt=2)


def ray_positions(draw: DRAW) -> Case:
    ray, t = torch.randint(0, 40, (draw(SAMPLES),)), draw(st.sampled_from([5.0, 500.0]))
    given = [torch.randn(40, 3), directions(40), ray, t * torch.rand(len(ray))]
    return Case(k.ray_positions, given, draw(st.sampled_from([(), (3,), (0, 1, 3)])), atol=3e-6, spoilt=3)


def voxels(draw: DRAW) -> Case:
    kept, terms = torch.rand(6**3) > 1 / 3, draw(st.sampled_from([0, 3, 15]))
    index, unit = torch.where(kept, kept.cumsum(0), 0).int(), 1.2 * torch.rand(draw(SAMPLES), 3) - 0.1
    size = int(index.max()) + 1
    density, color, views = torch.randn(size), torch.randn(size, 3), torch.randn(size, 3 * terms)
    vertex = torch.cat([torch.tensor([-1]), index.nonzero()[:, 0]]).int()
    rows, weights = k.locate_vertices(index, unit)
    basis = k.spherical_harmonics(directions(len(unit)))[:, 1 : 1 + terms]
    return draw(
        st.sampled_from(
            [
                Case(k.locate_vertices, [index, unit], spoilt=1),
                Case(k.interpolate_scalar, [density, index, unit], (0, 2), spoilt=2),
                Case(k.interpolate_scalar, [density, index, unit], (2,), spoilt=2),
                Case(k.interpolate_voxels, [density, color, views, rows, weights, basis], (5,), atol=3e-6, spoilt=4),
                Case(lambda values: k.total_variation(values, vertex, index, 1, size), [density], rtol=1e-5, spoilt=0),
                Case(lambda values: k.total_variation(values, vertex, index, 20, 60), [density], rtol=1e-5, spoilt=0),
            ]
        )
    )


def march(draw: DRAW) -> Case:
    near, far = draw(st.sampled_from([(None, None), (1.5, None), (2.0, 4.0), (4.0, 2.0), (0.0, 9.0)]))
    unit = draw(st.sampled_from([1e-3, 1.0, 1e3]))  # of length
    bounds = Bounds(unit * UNBOUNDED.aabb, draw(st.booleans()), near and unit * near, far and unit * far)
    origins = torch.cat([4 * directions(60), 2 * torch.rand(10, 3) - 1, torch.full((1, 3), 5.0)])
    toward = torch.cat([2.8 * torch.rand(70, 3) - 1.4 - origins[:70], torch.ones(1, 3)])
    toward[:9] = torch.cat([torch.eye(3), -torch.eye(3), torch.ones(3, 3)])  # along axes, and the diagonal
    rays = Rays(unit * origins, normalize(toward, dim=1))
    occupied = torch.rand(draw(st.sampled_from([1, 6, 24])) ** 3) < draw(st.sampled_from([0.0, 0.03, 0.5, 1.0]))
    samples, step = draw(st.sampled_from([1, 30, 100])), draw(st.sampled_from([1e-3, 0.05, 10.0]))
    shift = torch.rand(71) if draw(st.booleans()) else torch.zeros(71)
    return Case(lambda: k.march(rays, bounds, shift, occupied, samples, unit * step), [], rtol=0, atol=0)


def proposals(draw: DRAW) -> Case:
    bounds, s = replace(UNBOUNDED, near=0.1, unbounded=draw(st.booleans())), torch.rand(50, 13).sort(1).values
    if bounds.unbounded and draw(st.booleans()):
        bounds = replace(bounds, core=0.2 * bounds.aabb + 0.5)
    rays = Rays(4 * directions(50), directions(50))
    if draw(st.booleans()):
        return Case(lambda: k.interval_midpoints(rays, bounds, *bounds.near_far(rays), s), [], rtol=0, atol=0)
    share, shift = torch.rand(50, 12) * (torch.rand(50, 1) < 0.8), torch.rand(50) - 0.5
    return Case(
        lambda: k.resample(s, share, shift, 20), [], atol=1e-3
    )  # rounding moves edges in intervals of little weight


LEARNING = [composite, spherical_harmonics, hash_interpolate, mlp, planes, ray_positions, voxels]


@pytest.mark.parametrize("kernel", [*LEARNING, filter_visible, merge_low_weight, median_depth, march, proposals])
@given(data=st.data(), seed=st.integers(0, 1000))
def test_fast_kernel_any_input_matches_reference(kernel: Callable[[DRAW], Case], data: st.DataObject, seed: int):
    torch.manual_seed(seed)
    case = kernel(data.draw)
    assert_matches_reference(case.call, case.inputs, case.constants, case.rtol, case.atol, case.same_with_any_threads)


@pytest.mark.parametrize("kernel", LEARNING)
@given(data=st.data(), seed=st.integers(0, 1000))
def test_fast_kernel_nan_input_shows_as_in_reference(kernel: Callable[[DRAW], Case], data: st.DataObject, seed: int):
    torch.manual_seed(seed)
    case = kernel(data.draw)
    spoilt = case.inputs[case.spoilt]
    spoilt[torch.rand(spoilt.shape) < 0.1] = math.nan
    found = []
    for choice in ("reference", "auto"):
        k.set_kernels(choice)
        found.append(values_and_gradients(case.call, case.inputs, case.constants))
    gradients = sum(x.is_floating_point() and i not in case.constants for i, x in enumerate(case.inputs))
    for number, (expected, got) in enumerate(zip(*found, strict=True)):
        if number < len(found[0]) - gradients:
            spoilt_rows = [one.reshape(one.shape[:1] + (-1,)).isnan().any(-1) for one in (got, expected) if one.numel()]
            assert not spoilt_rows or torch.equal(*spoilt_rows), number
        else:  # it spreads with the order of sums; where the reference selects 0 the fast version may multiply by 0
            assert bool(got.isnan().any()) or not bool(expected.isnan().any()), number
