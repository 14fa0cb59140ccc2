"""Vector-matrix decomposition: a row per position and a column per channel, so that a corner's channels are read at once."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.kernels.gpu.hashgrid import locate_cell
from nerf_lightning.kernels.gpu.launch import kernel
from nerf_lightning.kernels.gpu.mlp import exp_slope, exponentiate

BLOCK = 32
"""Positions per program."""


@triton.jit
def order_axes(mode: tl.constexpr, x, y, z):
    """First and second axis of a mode's plane, and the axis of its line."""
    return (y, z, x) if mode == 0 else (x, z, y) if mode == 1 else (x, y, z)


@triton.jit
def interpolate(planes, lines, mode: tl.constexpr, x, y, z, side, channels, is_position, C: tl.constexpr):
    """A mode's plane and line [B, C] at positions, their lowest corner and vertex, and the fractions above these."""
    first, second, along = order_axes(mode, x, y, z)
    row, wr = locate_cell(first, side - 1)
    column, wc = locate_cell(second, side - 1)
    low, wl = locate_cell(along, side - 1)
    channel = tl.arange(0, C)[None, :]
    mask = is_position[:, None] & (channel < channels)
    corner = (mode * side + row) * side + column
    vertex = mode * side + low
    p = planes + (corner * channels)[:, None] + channel
    q = lines + (vertex * channels)[:, None] + channel
    wr, wc, wl = wr[:, None], wc[:, None], wl[:, None]
    upper = (1 - wc) * tl.load(p, mask, 0.0) + wc * tl.load(p + channels, mask, 0.0)
    lower = (1 - wc) * tl.load(p + side * channels, mask, 0.0) + wc * tl.load(p + (side + 1) * channels, mask, 0.0)
    line = (1 - wl) * tl.load(q, mask, 0.0) + wl * tl.load(q + channels, mask, 0.0)
    return (1 - wr) * upper + wr * lower, line, corner, vertex, wr, wc, wl


@kernel()
def multiply(
    planes, lines, unit, out, positions, side, channels, scale,
    IS_SUM: tl.constexpr, IS_EXP: tl.constexpr, C: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Products of planes and lines [N, 3, channels], or their sum [N], or its `exponentiate`."""
    i = tl.program_id(0) * B + tl.arange(0, B)
    is_position = i < positions
    x, y = tl.load(unit + i, is_position, 0.0), tl.load(unit + positions + i, is_position, 0.0)
    z = tl.load(unit + 2 * positions + i, is_position, 0.0)
    channel = tl.arange(0, C)[None, :]
    mask = is_position[:, None] & (channel < channels)
    total = tl.zeros([B, C], tl.float32)
    for mode in tl.static_range(3):
        plane, line, _, _, _, _, _ = interpolate(planes, lines, mode, x, y, z, side, channels, is_position, C)
        if IS_SUM:
            total += plane * line
        else:
            tl.store(out + (i[:, None] * 3 + mode) * channels + channel, plane * line, mask)
    if IS_SUM:
        value = tl.sum(total, axis=1)
        tl.store(out + i, exponentiate(value, scale) if IS_EXP else value, is_position)


@kernel()
def scatter(
    planes, lines, unit, out, grad, grad_planes, grad_lines, positions, side, channels, scale,
    IS_SUM: tl.constexpr, IS_EXP: tl.constexpr, C: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Adds the gradient of `multiply` to that of planes and lines."""
    i = tl.program_id(0) * B + tl.arange(0, B)
    is_position = i < positions
    x, y = tl.load(unit + i, is_position, 0.0), tl.load(unit + positions + i, is_position, 0.0)
    z = tl.load(unit + 2 * positions + i, is_position, 0.0)
    channel = tl.arange(0, C)[None, :]
    mask = is_position[:, None] & (channel < channels)
    grad_sum = tl.load(grad + i, is_position, 0.0) if IS_SUM else tl.zeros([B], tl.float32)
    if IS_EXP:
        grad_sum *= exp_slope(tl.load(out + i, is_position, 0.0), scale)
    for mode in tl.static_range(3):
        plane, line, corner, vertex, wr, wc, wl = interpolate(
            planes, lines, mode, x, y, z, side, channels, is_position, C
        )
        if IS_SUM:
            above = grad_sum[:, None] + tl.zeros([B, C], tl.float32)
        else:
            above = tl.load(grad + (i[:, None] * 3 + mode) * channels + channel, mask, 0.0)
        p = grad_planes + (corner * channels)[:, None] + channel
        q = grad_lines + (vertex * channels)[:, None] + channel
        to_plane, to_line = above * line, above * plane
        tl.atomic_add(p, to_plane * (1 - wr) * (1 - wc), mask, sem="relaxed")
        tl.atomic_add(p + channels, to_plane * (1 - wr) * wc, mask, sem="relaxed")
        tl.atomic_add(p + side * channels, to_plane * wr * (1 - wc), mask, sem="relaxed")
        tl.atomic_add(p + (side + 1) * channels, to_plane * wr * wc, mask, sem="relaxed")
        tl.atomic_add(q, to_line * (1 - wl), mask, sem="relaxed")
        tl.atomic_add(q + channels, to_line * wl, mask, sem="relaxed")


class PlaneLine(torch.autograd.Function):
    """`kernels.plane_line_products` or, if summed, `kernels.plane_line_sum`, with or without `truncated_exp` over a scale."""

    @staticmethod
    def forward(
        ctx, planes: Tensor, lines: Tensor, unit: Tensor, is_sum: bool, is_exp: bool = False, scale: float = 1.0
    ) -> Tensor:
        _, side, channels = lines.shape
        planes, lines, coords = planes.contiguous(), lines.contiguous(), unit.T.contiguous()
        out = unit.new_empty(len(unit)) if is_sum else unit.new_empty(len(unit), 3 * channels)
        ctx.shape = len(unit), side, channels, scale
        ctx.constants = {"IS_SUM": is_sum, "IS_EXP": is_exp, "C": triton.next_power_of_2(channels), "B": BLOCK}
        multiply((triton.cdiv(len(unit), BLOCK),), planes, lines, coords, out, *ctx.shape, **ctx.constants)
        ctx.save_for_backward(planes, lines, coords, out if is_exp else lines)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor):
        planes, lines, coords, _ = ctx.saved_tensors
        both = planes.new_zeros(planes.numel() + lines.numel())
        gradients = both[: planes.numel()].view_as(planes), both[planes.numel() :].view_as(lines)
        grid = (triton.cdiv(coords.shape[1], BLOCK),)
        scatter(grid, *ctx.saved_tensors, grad.contiguous(), *gradients, *ctx.shape, **ctx.constants)
        return *gradients, None, None, None, None
