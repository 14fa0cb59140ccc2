"""Vector-matrix decomposition of volumes into planes times lines (TensoRF, Chen et al. 2022, eq. 3)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from nerf_lightning.kernels import cpu, gpu
from nerf_lightning.kernels.activation import Activation, activate, truncated_exp
from nerf_lightning.kernels.backend import has_fast_kernel, has_gpu_kernel
from nerf_lightning.kernels.cached_constants import cache_constants

PLANE_AXES = ((1, 2), (0, 2), (0, 1))
"""Axes of each mode's plane; its line runs along the remaining axis: 0, 1, 2."""


class GatherIndices(NamedTuple):
    """Rows of all planes and lines to gather, mode by mode, and their interpolation weights."""

    plane_rows: Int[Tensor, "twelveN"]
    plane_weights: Float[Tensor, "4 N 3 1"]
    line_rows: Int[Tensor, "sixN"]
    line_weights: Float[Tensor, "2 N 3 1"]


@cache_constants
def _axes_and_steps(side: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """First and second axes of all planes, and row offsets of modes, corners and line ends."""
    axes = torch.tensor(PLANE_AXES, device=device).T.flatten()
    mode, end = torch.arange(3, device=device), torch.arange(2, device=device)
    corner = (end[:, None] * side + end).flatten()
    return axes, mode * side * side + corner[:, None, None], mode * side + end[:, None, None]


def gather_indices(unit: Float[Tensor, "N 3"], side: int) -> GatherIndices:
    """Gather indices of positions (clamped to [0, 1]^3) in planes and lines with `side` vertices along each axis."""
    axes, plane_steps, line_steps = _axes_and_steps(side, unit.device)
    scaled = unit.clamp(0, 1) * (side - 1)
    low = scaled.long().clamp_(0, side - 2)
    fraction = scaled - low
    end_weights = torch.stack([1 - fraction, fraction])
    (across, down), (row, column) = (x.index_select(-1, axes).split(3, dim=-1) for x in (end_weights, low))
    return GatherIndices(
        (torch.add(column, row, alpha=side) + plane_steps).flatten(),
        (across[:, None] * down).view(4, len(unit), 3, 1),
        (low + line_steps).flatten(),
        end_weights[..., None],
    )


@cache_constants
def _grid_sample_axes(device: torch.device) -> Int[Tensor, "3 2"]:
    """`PLANE_AXES` in the order of `grid_sample`, last axis first."""
    return torch.tensor(PLANE_AXES, device=device).flip(1)


def grid_sample_products(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3 C"]:
    """`plane_line_products` per mode by `grid_sample`: five times as fast as gathers on an NVIDIA H200; no gradient on MPS."""
    coords = unit.clamp(0, 1).mul(2).sub(1).T
    across = coords[_grid_sample_axes(unit.device)].mT[:, None]
    along = torch.stack([torch.zeros_like(coords), coords], dim=-1)[:, None]
    corners = grid_sample(planes.permute(0, 3, 1, 2), across, padding_mode="border", align_corners=True)
    ends = grid_sample(lines.mT[..., None], along, padding_mode="border", align_corners=True)
    nan = 0 * coords.sum(0)  # grid_sample hides NaN by clamping
    return (corners * ends + nan)[:, :, 0].permute(2, 0, 1)


def _products(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], at: GatherIndices
) -> Float[Tensor, "N 3 C"]:
    """Products with one gather for all planes and one for all lines, as GPUs are launch-bound."""
    channels = lines.shape[2]
    corners = planes.flatten(0, 2).index_select(0, at.plane_rows).view(*at.plane_weights.shape[:3], channels)
    ends = lines.flatten(0, 1).index_select(0, at.line_rows).view(*at.line_weights.shape[:3], channels)
    return (corners * at.plane_weights).sum(0) * (ends * at.line_weights).sum(0)


def products_reference(*volumes: tuple[Tensor, Tensor], unit: Float[Tensor, "N 3"]) -> list[Tensor]:
    """Products [N, 3, C] of volumes of the same resolution, in plain PyTorch for every device."""
    if unit.device.type == "cuda":
        return [grid_sample_products(*volume, unit) for volume in volumes]
    at = gather_indices(unit, volumes[0][1].shape[1])
    return [_products(*volume, at) for volume in volumes]


def _block(channels: int) -> tuple[int, ...]:
    """Tuple with the length of a worker's channel block: it fills a register and leaves blocks for every worker."""
    return (0,) * next(width for width in (8, 4, 2, 1) if channels % width == 0)


class _PlaneLine(torch.autograd.Function):
    @staticmethod
    def forward(ctx, planes: Tensor, lines: Tensor, unit: Tensor, summed: bool) -> Tensor:
        planes, lines, coords, channels = planes.contiguous(), lines.contiguous(), unit.T.contiguous(), lines.shape[2]
        out = torch.empty(1 if summed else 3 * channels, len(unit))
        arguments, lanes = (planes.flatten(1, 2), lines, coords, out), (0,) * channels
        if summed:
            cpu.vector_matrix.sums(*arguments, lanes)
        else:
            cpu.vector_matrix.products(*arguments, lanes, _block(channels))
        ctx.save_for_backward(planes, lines, coords)
        return out.T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, Tensor | None, None]:
        planes, lines, coords = ctx.saved_tensors
        grad_planes, grad_lines = torch.zeros_like(planes), torch.zeros_like(lines)
        arguments, block = (planes.flatten(1, 2), lines, coords, grad.T.contiguous()), _block(lines.shape[2])
        cpu.vector_matrix.scatter(*arguments, grad_planes.flatten(1, 2), grad_lines, block, 2 * block)
        grad_unit = None
        if ctx.needs_input_grad[2]:
            grad_unit = torch.empty_like(coords)
            cpu.vector_matrix.position_gradient(*arguments, grad_unit, (0,) * lines.shape[2], block)
            grad_unit = grad_unit.T
        return grad_planes, grad_lines, grad_unit, None


def plane_line_products(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N threeC"]:
    """Products of each plane's channels (bilinear interpolation) and its line's channels (linear).

    Args:
        planes: planes of the axes (1, 2), (0, 2) and (0, 1); S >= 2 vertices from 0 to 1 inclusive.
        lines: lines along the axes 0, 1 and 2.
        unit: positions, clamped to [0, 1]^3.
    """
    if has_fast_kernel(planes, lines, unit):
        return _PlaneLine.apply(planes, lines, unit, False)
    if has_gpu_kernel(planes, lines, constants=(unit,)):
        return gpu.vector_matrix.PlaneLine.apply(planes, lines, unit, False)
    return products_reference((planes, lines), unit=unit)[0].flatten(1)


def plane_line_sum(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"],
    activation: Activation = None, scale: float = 1.0,
) -> Float[Tensor, "N"]:  # fmt: skip
    """Sum of `plane_line_products` at each position, with an activation divided by `scale`."""
    if has_fast_kernel(planes, lines, unit):
        total = _PlaneLine.apply(planes, lines, unit, True)[:, 0]
    elif has_gpu_kernel(planes, lines, constants=(unit,)):
        if activation is truncated_exp:
            return gpu.vector_matrix.PlaneLine.apply(planes, lines, unit, True, True, scale)
        total = gpu.vector_matrix.PlaneLine.apply(planes, lines, unit, True)
    else:
        total = products_reference((planes, lines), unit=unit)[0].sum((1, 2))
    return activate(total, activation, scale)


def plane_line_sum_and_products(
    summed: tuple[Float[Tensor, "3 S S A"], Float[Tensor, "3 S A"]],
    separate: tuple[Float[Tensor, "3 S S B"], Float[Tensor, "3 S B"]],
    unit: Float[Tensor, "N 3"],
    activation: Activation = None,
    scale: float = 1.0,
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N threeB"]]:
    """`plane_line_sum` of one volume and `plane_line_products` of another of the same resolution."""
    is_on_gpu = has_gpu_kernel(*summed, *separate, constants=(unit,))
    if is_on_gpu or has_fast_kernel(*summed, *separate, unit):
        return plane_line_sum(*summed, unit, activation, scale), plane_line_products(*separate, unit)
    total, products = products_reference(summed, separate, unit=unit)
    return activate(total.sum((1, 2)), activation, scale), products.flatten(1)
