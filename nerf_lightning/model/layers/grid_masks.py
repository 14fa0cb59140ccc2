"""Masks over grids in the unit cube: neighbours, and the vertices that are read from some cells of another grid."""

import torch
from jaxtyping import Bool
from torch import Tensor


def dilate(mask: Bool[Tensor, "S S S"]) -> Bool[Tensor, "S S S"]:
    """Also True at all neighbours, including diagonal ones."""
    for axis in range(3):
        wide, last = mask.clone(), mask.shape[axis] - 1
        wide.narrow(axis, 0, last).logical_or_(mask.narrow(axis, 1, last))
        wide.narrow(axis, 1, last).logical_or_(mask.narrow(axis, 0, last))
        mask = wide
    return mask


def vertices_of_cells(find_visible_cells: Bool[Tensor, "G G G"], cells: int) -> Bool[Tensor, "V V V"]:
    """Vertices, V = cells + 1 along an axis, of all cells of a grid that overlap reached ones."""
    mask = find_visible_cells
    for axis in range(3):
        count = mask.shape[axis]
        first = torch.arange(cells, device=mask.device) * count // cells
        beyond = -(-torch.arange(1, cells + 1, device=mask.device) * count // cells)
        sums = mask.int().cumsum(axis)
        sums = torch.cat([torch.zeros_like(sums.narrow(axis, 0, 1)), sums], dim=axis)
        mask = sums.index_select(axis, beyond) > sums.index_select(axis, first)
    for axis in range(3):
        wide = list(mask.shape)
        wide[axis] += 1
        ends = mask.new_zeros(wide)
        ends.narrow(axis, 0, mask.shape[axis]).logical_or_(mask)
        ends.narrow(axis, 1, mask.shape[axis]).logical_or_(mask)
        mask = ends
    return mask
