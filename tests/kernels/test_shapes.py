"""Tensors of wrong shapes, each of which stops the test that meets them."""

from collections.abc import Callable

import jaxtyping
import pytest
import torch
from torch import Tensor

from nerf_lightning import kernels as k
from nerf_lightning.cameras import Bounds, Rays

ONE = torch.zeros(3)
RAY, OFFSETS, ROWS = torch.zeros(3).long(), torch.tensor([0, 3]), torch.zeros(3, 8, dtype=torch.int32)
BOX, RAYS = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]])), Rays(torch.rand(3, 3), torch.rand(3, 3))
CELLS, UNIT = torch.ones(64, dtype=torch.bool), torch.rand(4, 3)
LAYERS = [(torch.rand(6, 5), torch.rand(6))]


def read(density: Tensor, colour: Tensor, views: Tensor) -> None:
    k.read_voxels(density, colour, views, ROWS, torch.zeros(3, 8), torch.zeros(3, 3))


CALLS: dict[str, Callable[[], object]] = {
    "lengths": lambda: k.volume_weights(ONE, ONE[1:], RAY, OFFSETS),
    "colours of two channels": lambda: k.composite(ONE, torch.zeros(3, 2), ONE, ONE, RAY, OFFSETS),
    "too little thickness": lambda: k.keep_visible(ONE[1:], (ONE, ONE, RAY, OFFSETS), 1e-4, 0.0),
    "directions of two coordinates": lambda: k.spherical_harmonics(torch.zeros(5, 2)),
    "cells that are no truths": lambda: k.march(RAYS, BOX, ONE, ONE, ONE, torch.ones(64), 8, 0.1),
    "directions of points": lambda: k.points(RAYS.origins, RAYS.directions[:, :2], RAY, ONE),
    "too few further inputs": lambda: k.mlp(torch.zeros(4, 5), LAYERS, torch.zeros(3, 1)),
    "planes": lambda: k.plane_line_products(torch.rand(3, 3, 4, 2), torch.rand(3, 4, 2), UNIT),
    "colours of vertices": lambda: read(torch.zeros(9), torch.zeros(9, 2), torch.zeros(9, 9)),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_kernel_wrong_shape_or_type_is_refused(call: Callable[[], object]):
    with pytest.raises(jaxtyping.TypeCheckError):
        call()


def test_hash_interpolate_other_axes_are_refused():
    with pytest.raises(ValueError, match="reshape"):
        k.hash_interpolate(torch.zeros(27, 2), torch.rand(4, 2), [(2, 2, 2)], [27])
