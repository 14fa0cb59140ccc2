"""Planes times lines: a volume as a sum of products (vector-matrix decomposition; TensoRF, Chen et al. 2022, eq. 3)."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels.switch import fast

PLANE_AXES = ((1, 2), (0, 2), (0, 1))
"""Axes of each mode's plane; its line runs along the axis that is left: 0, 1, 2."""


def plane_line_products_reference(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N threeC"]:
    """`plane_line_products` in plain torch, for every device and differentiable in the positions too."""
    side = lines.shape[1]
    scaled = unit.clamp(0, 1).T * (side - 1)
    low = scaled.long().clamp(0, side - 2)
    fraction = scaled - low
    share = torch.stack([1 - fraction, fraction])[..., None]
    products = []
    for mode, (a, b) in enumerate(PLANE_AXES):
        plane, line, corner = planes[mode].flatten(0, 1), lines[mode], low[a] * side + low[b]
        ends = [share[i, mode] * line.index_select(0, low[mode] + i) for i in (0, 1)]
        corners = [
            share[i, a] * share[j, b] * plane.index_select(0, corner + i * side + j) for i in (0, 1) for j in (0, 1)
        ]
        products.append(torch.stack(corners).sum(0) * torch.stack(ends).sum(0))
    return torch.cat(products, dim=1)


def _block(channels: int) -> int:
    """Channels that one worker adds up together: few enough that all workers find some, enough to fill a register."""
    return next(width for width in (8, 4, 2, 1) if channels % width == 0)


class _PlaneLine(torch.autograd.Function):
    @staticmethod
    def forward(ctx, planes: Tensor, lines: Tensor, unit: Tensor, summed: bool) -> Tensor:
        from nerf_lightning.kernels.cpu import planes as cpu
        from nerf_lightning.kernels.cpu import workers

        planes, lines, places, channels = planes.contiguous(), lines.contiguous(), unit.T.contiguous(), lines.shape[2]
        out = torch.empty(1 if summed else 3 * channels, len(unit))
        given = planes.detach().flatten(1, 2).numpy(), lines.detach().numpy(), places.numpy()
        kernel = cpu.sums if summed else cpu.products
        kernel(*given, out.numpy(), (0,) * channels, workers())
        ctx.save_for_backward(planes, lines, places)
        return out.T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        from nerf_lightning.kernels.cpu import planes as cpu
        from nerf_lightning.kernels.cpu import workers

        planes, lines, places = ctx.saved_tensors
        grad_planes, grad_lines = torch.zeros_like(planes), torch.zeros_like(lines)
        given = planes.flatten(1, 2).numpy(), lines.numpy(), places.numpy(), grad.T.contiguous().numpy()
        lanes = (0,) * _block(lines.shape[2])
        cpu.scatter(*given, grad_planes.flatten(1, 2).numpy(), grad_lines.numpy(), lanes, workers())
        return grad_planes, grad_lines, None, None


def _fast(planes: Tensor, lines: Tensor, unit: Tensor) -> bool:
    return fast(planes, lines, unit) and not unit.requires_grad


def plane_line_products(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N threeC"]:
    """Each plane's channels, interpolated bilinearly, times those of the line across it, interpolated linearly.

    Args:
        planes: over the axes (1, 2), (0, 2) and (0, 1), vertices from 0 to 1 with both ends, S at least 2.
        lines: along the axes 0, 1 and 2.
        unit: positions in [0, 1]^3; outside they are clamped.
    """
    if _fast(planes, lines, unit):
        return _PlaneLine.apply(planes, lines, unit, False)
    return plane_line_products_reference(planes, lines, unit)


def plane_line_sum(
    planes: Float[Tensor, "3 S S C"], lines: Float[Tensor, "3 S C"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N"]:
    """The sum of what `plane_line_products` gives at each position."""
    if _fast(planes, lines, unit):
        return _PlaneLine.apply(planes, lines, unit, True)[:, 0]
    return plane_line_products_reference(planes, lines, unit).sum(1)
