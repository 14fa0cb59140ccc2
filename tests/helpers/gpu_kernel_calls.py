"""Calls of all GPU kernels: empty rays, NaN, full buffers, colliding entries."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch.nn.functional import normalize

from nerf_lightning import kernels
from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.model.hashgrid import cubic_cells, table_sizes
from tests.helpers.ragged_samples import make_ragged_samples

Call = tuple[Callable[..., Any], list[torch.Tensor], tuple[int, ...]]
"""A function of tensors, its inputs, and the numbers of those that take no gradient."""

RAY_COUNTS = [5, 0, 40, 0, 0, 1, 33]
"""Samples of each ray: none, fewer and more than a program takes at a time."""


def march_through_ball(resolution: int, num_rays: int, samples: int, capacity: int | None) -> Call:
    origins = 4 * normalize(torch.randn(num_rays, 3), dim=1)
    directions = normalize(0.9 * torch.randn(num_rays, 3) - origins, dim=1)  # some rays miss the box
    bounds = Bounds(torch.tensor([[-1.0, -1.1, -0.9], [1, 1.05, 1]]))
    axis = (torch.arange(resolution) + 0.5) / (resolution / 2) - 1
    ball = axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2 < 0.5
    origins[1, 0] = math.nan
    directions[2] = torch.eye(3)[1]

    def call(origins: Any, directions: Any, shift: Any, occupied: Any) -> Any:
        rays, step = Rays(origins, directions), 4.0 / samples
        t, dt, ray, offsets = kernels.march(rays, bounds, shift, occupied, samples, step, capacity)
        return [t * (dt > 0), dt, ray * (dt > 0), offsets]

    occupied = (ball & (torch.rand(ball.shape) < 0.7)).flatten()
    return call, [origins, directions, torch.rand(num_rays), occupied], tuple(range(4))


def filter_samples(capacity: int | None, max_dropped: float, early_stop_eps: float) -> Call:
    samples = make_ragged_samples(RAY_COUNTS)
    depth = 2 * torch.rand(len(samples)) ** 4
    depth[-10] = math.nan  # on the last ray: the reference's sums carry it on to later rays

    def call(depth: Any, t: Any, dt: Any, ray: Any, offsets: Any) -> Any:
        limits = early_stop_eps, torch.tensor(0.02), capacity, max_dropped
        depths, (t, dt, ray, offsets), complete = kernels.filter_visible(depth, (t, dt, ray, offsets), *limits)
        return [depths, t * (dt > 0), dt, ray * (dt > 0), offsets, *([] if complete is None else [complete.int()])]

    return call, [depth, samples.t, samples.dt, samples.ray, samples.offsets], tuple(range(5))


def composite_samples(density_scale: float, has_nan: bool = False) -> Call:
    samples = make_ragged_samples(RAY_COUNTS)
    density, rgb = density_scale * torch.rand(len(samples)) ** 3, torch.rand(len(samples), 3)
    if has_nan:
        density[-10] = math.nan
    inputs = [density, rgb, samples.t, samples.dt, samples.ray, samples.offsets]
    # The reference's gradient carries NaN on to other rays.
    return kernels.composite, inputs, (0, 1, 2, 3) if has_nan else (2, 3)


def locate_samples(num_rays: int, count: int, resolution: int) -> Call:
    bounds = Bounds(torch.tensor([[-1.0, -1.1, -0.9], [1, 1.05, 1]]))
    ray, t = torch.randint(0, num_rays, (count,)), 4 * torch.rand(count)
    t[:1] = math.nan

    def call(origins: Any, directions: Any) -> Any:
        positions, marks = kernels.ray_positions(origins, directions, ray, t), torch.zeros(resolution**3).int()
        kernels.mark_cells(marks, 7, bounds, positions)
        return [positions, marks]

    return call, [torch.randn(num_rays, 3), normalize(torch.randn(num_rays, 3), dim=1)], (0, 1)


def compare_colors(num_rays: int, channels: int, has_weights: bool, is_partial: bool) -> Call:
    pixels, weights = (255 * torch.rand(num_rays, channels)).byte(), torch.rand(num_rays)
    complete, foreground = torch.rand(num_rays) < 0.7, torch.rand(3, num_rays)
    foreground[1, ~complete] = math.nan
    background = torch.rand(num_rays, 3) if is_partial else torch.rand(3).expand(num_rays, 3)
    options, variance = (weights if has_weights else None, complete if is_partial else None), (channels - 3) / 12

    def call(foreground: Any, opacity: Any) -> Any:
        *losses, errors = kernels.photometric_loss(foreground.T, opacity, background, pixels, *options, variance)
        return [*(loss for loss in losses if loss is not None), errors.detach()]

    return call, [foreground if is_partial else foreground.nan_to_num(), torch.rand(num_rays)], ()


def encode_positions(levels: int, log2_size: int, features: int, max_resolution: int, count: int) -> Call:
    cells = cubic_cells(levels, 4, max_resolution)
    sizes = table_sizes(cells, 2**log2_size)
    unit = torch.rand(count, 3) * 1.1 - 0.05  # some are clamped
    unit[0, 1] = math.nan
    unit[1:5] = torch.tensor([1.0, 0, 1])  # on vertices, and all of them in the same entries
    tables = torch.randn(sum(sizes), features)
    return lambda tables, unit: kernels.hash_interpolate(tables, unit, cells, sizes), [tables, unit], ()


def multiply_planes(function: Callable[..., Any], side: int, channels: int, count: int, *activation: Any) -> Call:
    unit = torch.rand(count, 3) * 1.1 - 0.05
    unit[0, 1] = math.nan
    unit[1:5] = torch.tensor([1.0, 0, 1])
    volume = torch.randn(3, side, side, channels), torch.randn(3, side, channels)
    return lambda planes, lines: function(planes, lines, unit, *activation), list(volume), ()


def run_network(widths: list[int], num_extra: int, num_head: int, count: int, *activation: Any) -> Call:
    size = 0.25 if activation else 1.0  # else a sigmoid saturates
    parameters = [size * torch.randn(shape) for i, o in pairwise(widths) for shape in ((o, i), (o,))]
    x = torch.randn(count, widths[0] - num_extra)
    x[1, 0] = math.nan

    def call(x: Any, extra: Any, *parameters: Any) -> Any:
        layers = list(zip(parameters[::2], parameters[1::2], strict=True))
        return kernels.mlp_heads(x, layers, num_head, extra if num_extra else None, *activation)

    return call, [x, torch.randn(count, num_extra), *parameters], (1,)


def locate_midpoints(num_rays: int, steps: int) -> Call:
    box = torch.tensor([[-1.0, -1.1, -0.9], [1, 1.05, 1]])
    bounds = Bounds(4 * box, unbounded=True, core=box)
    origins, directions = 2 * torch.randn(num_rays, 3), normalize(torch.randn(num_rays, 3), dim=1)  # some miss the box
    directions[1] = torch.tensor([0.0, 0, 1])
    origins[2, 0] = math.nan

    def call(origins: Any, directions: Any, s: Any) -> Any:
        rays = Rays(origins, directions)
        return kernels.interval_midpoints(rays, bounds, *bounds.near_far(rays), s)

    return call, [origins, directions, make_edges(num_rays, steps)], (0, 1, 2)


def make_edges(num_rays: int, intervals: int) -> torch.Tensor:
    """Ascending edges in [0, 1], some equal."""
    edges = torch.rand(num_rays, intervals + 1).sort(1).values
    edges[:, 3] = edges[:, 2]
    return edges


def resample_rays(num_rays: int, steps: int, count: int) -> Call:
    pdf = torch.rand(num_rays, steps) + 0.2
    pdf[1], pdf[2, 4] = 0, math.nan
    inputs = [make_edges(num_rays, steps), pdf, torch.rand(num_rays) - 0.5]
    return lambda *inputs: kernels.resample(*inputs, count), inputs, (0, 1, 2)


def weigh_proposals(num_rays: int, steps: int, levels: int) -> Call:
    features = 2 * torch.randn(num_rays * steps, levels)
    features[:steps], features[-3] = -100, math.nan
    inputs = [features, torch.rand(num_rays, steps) * (torch.rand(num_rays, steps) < 0.8)]
    return lambda *inputs: kernels.proposal_weights(*inputs, -1.0, 0.7), inputs, (1,)


def weigh_samples(num_rays: int, per_ray: int) -> Call:
    ray = torch.arange(num_rays).repeat_interleave(per_ray)
    density, dt, offsets = 9 * torch.rand(len(ray)) ** 3, torch.rand(len(ray)), torch.arange(num_rays + 1) * per_ray
    return lambda *inputs: kernels.volume_weights(*inputs, per_ray), [density, dt, ray, offsets], (1,)


def bound_weights(num_rays: int, count: int, steps: int) -> Call:
    weights, proposed = torch.rand(num_rays, count) / count, torch.rand(num_rays, steps) / steps
    weights[1], weights[2, 1], proposed[3] = 0, math.nan, 0
    edges = torch.cat([make_edges(num_rays - 2, count), torch.linspace(0, 1, count + 1).expand(2, -1)])
    return kernels.interlevel_loss, [proposed, make_edges(num_rays, steps), edges, weights], (1, 2, 3)


def penalize_weights(has_nan: bool) -> Call:
    samples = make_ragged_samples(RAY_COUNTS)
    weights, residual = torch.rand(len(samples)) / 5, torch.randn(len(samples), 3)
    residual[0] = 0
    if has_nan:
        weights[-10] = math.nan

    def call(weights: Any, residual: Any, texturelessness: Any) -> Any:
        factors = 0.5, 2.0, 1.5
        return list(kernels.weight_losses(weights, residual, samples.packed, 0.7, factors, texturelessness).values())

    return call, [weights, residual, torch.rand(len(RAY_COUNTS))], (0, 1, 2) if has_nan else (2,)


def list_calls() -> dict[str, Call]:
    """All calls by name."""
    torch.manual_seed(3)
    return {
        "march, exact count": march_through_ball(8, 13, 40, None),
        "march, buffer with space": march_through_ball(32, 7, 150, 2000),
        "march, full buffer": march_through_ball(16, 10, 60, 20),
        "filter_visible, exact count": filter_samples(None, math.inf, 1e-2),
        "filter_visible, buffer with space": filter_samples(90, 0.05, 0.3),
        "filter_visible, full buffer": filter_samples(20, math.inf, 1e-4),
        "composite, thin": composite_samples(1.0),
        "composite, opaque": composite_samples(300.0),
        "composite, empty": composite_samples(0.0),
        "composite, NaN": composite_samples(1.0, has_nan=True),
        "hash_interpolate": encode_positions(4, 10, 2, 40, 150),
        "hash_interpolate, many features": encode_positions(2, 8, 4, 20, 40),
        "hash_interpolate, one feature": encode_positions(3, 6, 1, 64, 129),
        "plane_line_products": multiply_planes(kernels.plane_line_products, 12, 16, 40),
        "plane_line_products, odd channels": multiply_planes(kernels.plane_line_products, 5, 3, 33),
        "plane_line_sum": multiply_planes(kernels.plane_line_sum, 20, 8, 64),
        "interval_midpoints": locate_midpoints(20, 9),
        "resample": resample_rays(5, 24, 16),
        "resample, as many as fit": resample_rays(4, 64, 40),
        "proposal_weights": weigh_proposals(6, 24, 2),
        "proposal_weights, one level": weigh_proposals(3, 64, 1),
        "volume_weights": weigh_samples(5, 16),
        "interlevel_loss": bound_weights(7, 16, 48),
        "weight_losses": penalize_weights(False),
        "weight_losses, NaN": penalize_weights(True),
        "mlp, one hidden layer": run_network([16, 64, 16], 0, 1, 70),
        "mlp, two hidden layers": run_network([31, 64, 64, 3], 16, 0, 100),
        "mlp, odd widths": run_network([60, 24, 3], 12, 2, 5),
        "mlp, exponential": run_network([16, 64, 16], 0, 1, 70, kernels.truncated_exp, 1.3),
        "mlp, sigmoid": run_network([31, 64, 64, 3], 16, 3, 65, torch.sigmoid),
        "mlp, ReLU": run_network([16, 16, 4], 0, 1, 9, torch.relu, 2.0),
        "plane_line_sum, two vertices": multiply_planes(kernels.plane_line_sum, 2, 1, 20),
        "plane_line_sum, exponential": multiply_planes(kernels.plane_line_sum, 20, 8, 64, kernels.truncated_exp, 0.7),
        "locate_samples": locate_samples(5, 300, 8),
        "locate_samples, one": locate_samples(1, 1, 2),
        "photometric_loss": compare_colors(150, 4, True, True),
        "photometric_loss, opaque photos": compare_colors(33, 3, True, False),
        "photometric_loss, without weights": compare_colors(7, 4, False, True),
    }
