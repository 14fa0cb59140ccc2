"""TensoRF: a volume as a sum of planes times lines (vector-matrix decomposition; Chen et al. 2022, eq. 3)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.constants import constant
from nerf_lightning.kernels.switch import has_fast

PLANE_AXES = ((1, 2), (0, 2), (0, 1))
"""Axes of each mode's plane; its line runs along the remaining axis: 0, 1, 2."""


@constant
def _crossed(device: torch.device) -> Int[Tensor, "3 2"]:
    """`PLANE_AXES` as `grid_sample` wants them, the last one first."""
    return torch.tensor(PLANE_AXES, device=device).flip(1)


def products_reference(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3 C"]:
    """`plane_line_products`, mode by mode, in plain PyTorch for every device: by its sampling of pictures, as a gather takes
    five times as long on an NVIDIA H200."""
    places = unit.clamp(0, 1).mul(2).sub(1).T
    known = 1 + 0 * places.sum(0)  # `grid_sample` passes over what is not a number, or crashes; it is to show
    places = places.nan_to_num()
    across = places[_crossed(unit.device)].mT[:, None]
    along = torch.stack([torch.zeros_like(places), places], dim=-1)[:, None]
    corners = grid_sample(planes.permute(0, 3, 1, 2), across, align_corners=True)
    ends = grid_sample(lines.mT[..., None], along, align_corners=True)
    return (corners * ends * known)[:, :, 0].permute(2, 0, 1)


def _block(channels: int) -> tuple[int, ...]:
    """As long as a block of channels that one worker adds up together: enough to fill a register, few enough that every worker
    gets some."""
    return (0,) * next(width for width in (8, 4, 2, 1) if channels % width == 0)


class _PlaneLine(torch.autograd.Function):
    @staticmethod
    def forward(ctx, planes: Tensor, lines: Tensor, unit: Tensor, summed: bool) -> Tensor:
        planes, lines, places, channels = planes.contiguous(), lines.contiguous(), unit.T.contiguous(), lines.shape[2]
        out = torch.empty(1 if summed else 3 * channels, len(unit))
        given, lanes = (planes.flatten(1, 2), lines, places, out), (0,) * channels
        if summed:
            cpu.planes.sums(*given, lanes)
        else:
            cpu.planes.products(*given, lanes, _block(channels))
        ctx.save_for_backward(planes, lines, places)
        return out.T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, Tensor | None, None]:
        planes, lines, places = ctx.saved_tensors
        grad_planes, grad_lines = torch.zeros_like(planes), torch.zeros_like(lines)
        given, block = (planes.flatten(1, 2), lines, places, grad.T.contiguous()), _block(lines.shape[2])
        cpu.planes.scatter(*given, grad_planes.flatten(1, 2), grad_lines, block, 2 * block)
        moved = None
        if ctx.needs_input_grad[2]:
            moved = torch.empty_like(places)
            cpu.planes.slope(*given, moved, (0,) * lines.shape[2], block)
            moved = moved.T
        return grad_planes, grad_lines, moved, None


def plane_line_products(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N threeC"]:
    """Each plane's channels, interpolated bilinearly, times those of the line across it, interpolated linearly.

    Args:
        planes: over the axes (1, 2), (0, 2) and (0, 1); S >= 2 vertices from 0 to 1, both included.
        lines: along the axes 0, 1 and 2.
        unit: positions in [0, 1]^3; outside they are clamped.
    """
    if has_fast(planes, lines, unit):
        return _PlaneLine.apply(planes, lines, unit, False)
    return products_reference(planes, lines, unit).flatten(1)


def plane_line_sum(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N"]:
    """The sum of what `plane_line_products` gives at each position."""
    if has_fast(planes, lines, unit):
        return _PlaneLine.apply(planes, lines, unit, True)[:, 0]
    return products_reference(planes, lines, unit).sum((1, 2))
