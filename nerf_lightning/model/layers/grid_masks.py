"""Boolean masks over grids in the unit cube: dilation, and vertices of cells."""

import torch
from jaxtyping import Bool
from torch import Tensor


def dilate(mask: Bool[Tensor, "S S S"]) -> Bool[Tensor, "S S S"]:
    """Dilates a mask by one cell in all 26 directions."""
    for axis in range(3):
        dilated, last = mask.clone(), mask.shape[axis] - 1
        dilated.narrow(axis, 0, last).logical_or_(mask.narrow(axis, 1, last))
        dilated.narrow(axis, 1, last).logical_or_(mask.narrow(axis, 0, last))
        mask = dilated
    return mask


def vertices_of_cells(visible_cells: Bool[Tensor, "G G G"], cells: int) -> Bool[Tensor, "V V V"]:
    """Vertices (V = cells + 1 along an axis) of the cells of a grid that overlap visible cells of another grid."""
    mask = visible_cells
    for axis in range(3):
        count = mask.shape[axis]
        first = torch.arange(cells, device=mask.device) * count // cells
        last = -(-torch.arange(1, cells + 1, device=mask.device) * count // cells)
        sums = mask.int().cumsum(axis)
        sums = torch.cat([torch.zeros_like(sums.narrow(axis, 0, 1)), sums], dim=axis)
        mask = sums.index_select(axis, last) > sums.index_select(axis, first)
    for axis in range(3):
        shape = list(mask.shape)
        shape[axis] += 1
        ends = mask.new_zeros(shape)
        ends.narrow(axis, 0, mask.shape[axis]).logical_or_(mask)
        ends.narrow(axis, 1, mask.shape[axis]).logical_or_(mask)
        mask = ends
    return mask
