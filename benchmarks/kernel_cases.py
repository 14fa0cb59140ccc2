"""Kernel cases: the kernels' inputs in one training step, and which of them get gradients."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning import kernels
from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.model import HashGrid, HashGrid2DField, VectorMatrix, VoxelField
from nerf_lightning.model.hashgrid import cubic_cells

NUM_SAMPLES, NUM_RAYS = 1 << 15, 1 << 12
MAX_STEPS, GRID_RESOLUTION = 192, 64
"""Most ray marching steps, and cells along a side of the occupancy grid."""
MIN_TRANSMITTANCE, MIN_THICKNESS, MIN_SAMPLE_WEIGHT = 1e-4, 5e-3, 1e-2
MIN_KINK_DISTANCE = 1e-5
"""Least distance of a ReLU's input from zero, so that rounding cannot flip its gradient."""
PRUNED_FRACTION = 1 / 3
"""Fraction of the voxel vertices that are pruned."""

Outputs = Sequence[Tensor]


@dataclass(frozen=True)
class Case:
    """A kernel call of a training; `set_kernels` and the inputs' device select the version."""

    call: Callable[..., Tensor | Outputs]
    inputs: tuple[Tensor, ...]
    """On the CPU."""
    num_trainable: int = 0
    """Number of leading inputs that get gradients."""
    kind: str = "dense"
    """Kind of the outputs: "dense" tensors, "packed" samples of varying number, or "rows" and their weights."""

    def to_device(self, device: torch.device) -> tuple[Tensor, ...]:
        """Copies the inputs to a device, the trainable ones as leaves."""
        copies = [x.detach().to(device, copy=True) for x in self.inputs]
        return tuple(x.requires_grad_() if number < self.num_trainable else x for number, x in enumerate(copies))

    def outputs(self, inputs: tuple[Tensor, ...]) -> list[Tensor]:
        """Calls the kernel and returns its outputs as a list."""
        out = self.call(*inputs)
        return [out] if isinstance(out, Tensor) else list(out)

    def gradients(self, inputs: tuple[Tensor, ...], outputs: list[Tensor], grads: list[Tensor]) -> list[Tensor]:
        """Gradients of the trainable inputs, given those of the outputs."""
        trainable = inputs[: self.num_trainable]
        return list(torch.autograd.grad(outputs, trainable, grads)) if trainable else []


@contextmanager
def kernel_version(choice: str) -> Iterator[None]:
    """Selects the kernels' version within a block."""
    kernels.set_kernels(choice)
    try:
        yield
    finally:
        kernels.set_kernels("auto")


def march(unbounded: bool, capacity: int | None, *tensors: Tensor) -> Outputs:
    origins, directions, aabb, shift, occupied = tensors
    rays, bounds = Rays(origins, directions), Bounds(aabb, unbounded)
    return kernels.march(rays, bounds, shift, occupied, MAX_STEPS, 3.46 / MAX_STEPS, capacity)


def filter_visible(capacity: int | None, optical_depth: Tensor, *packed: Tensor) -> Outputs:
    t, dt, ray, offsets = packed
    return kernels.filter_visible(optical_depth, (t, dt, ray, offsets), MIN_TRANSMITTANCE, MIN_THICKNESS, capacity)[1]


def merge_low_weight(optical_depth: Tensor, *packed: Tensor) -> Outputs:
    t, dt, ray, offsets = packed
    return kernels.merge_low_weight(optical_depth, (t, dt, ray, offsets), MIN_SAMPLE_WEIGHT)[1]


def mark_cells(marks: Tensor, aabb: Tensor, positions: Tensor) -> Tensor:
    marks = marks.clone()
    kernels.mark_cells(marks, 3, Bounds(aabb), positions)
    return marks


def mark_rows(last_seen: Tensor, rows: Tensor) -> Tensor:
    last_seen = last_seen.clone()
    kernels.mark_rows(last_seen, rows, 3)
    return last_seen


def mlp(x: Tensor, *rest: Tensor) -> Tensor:
    """MLP whose weights and biases alternate in `rest`, followed by the extra inputs."""
    *flat, extra = rest
    return kernels.mlp(x, list(zip(flat[::2], flat[1::2], strict=True)), extra)


def plane_line_sum_and_products(*tensors: Tensor) -> Outputs:
    planes, lines, others, other_lines, unit = tensors
    return kernels.plane_line_sum_and_products((planes, lines), (others, other_lines), unit)


def total_variation(values: Tensor, vertex: Tensor, index: Tensor) -> Tensor:
    return kernels.total_variation(values, vertex, index, 1, len(vertex))


def hash_interpolate(grid: HashGrid, tables: Tensor, unit: Tensor) -> Tensor:
    return kernels.hash_interpolate(tables, unit, grid.cells, grid.sizes)


def make_converging_rays() -> tuple[Tensor, ...]:
    """Inputs of `march`: rays from a sphere of radius 4 toward the center of a box, the box, jitter, and a ball of
    occupied cells."""
    origins = 4 * normalize(torch.randn(NUM_RAYS, 3), dim=1)
    directions = normalize(0.5 * torch.randn(NUM_RAYS, 3) - origins, dim=1)
    axis = (torch.arange(GRID_RESOLUTION) + 0.5) / (GRID_RESOLUTION / 2) - 1
    occupied = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2 < 0.1).flatten()
    box = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    return origins, directions, box, torch.rand(NUM_RAYS), occupied


def sparsify(field: VoxelField) -> None:
    """Prunes random vertices of a voxel field and randomizes the others."""
    keep = torch.rand(len(field.index)) > PRUNED_FRACTION
    rows = 1 + int(keep.sum())
    field.set_vertices(keep, [torch.randn(rows, *table.shape[1:]) for table in field.tables])


@torch.no_grad()
def avoid_kinks(x: Tensor, extra: Tensor, layers: Sequence[torch.nn.Linear]) -> Tensor:
    """Rows of inputs for which no ReLU is so close to its kink that rounding decides the gradient."""
    h, clear = torch.cat([x, extra], dim=1), torch.ones(len(x), dtype=torch.bool)
    for layer in layers[:-1]:
        preactivation = layer(h)
        clear &= (preactivation.abs() > MIN_KINK_DISTANCE).all(1)
        h = torch.relu(preactivation)
    return clear.nonzero()[:, 0]


def make_cases(choice: str = "reference") -> dict[str, Case]:
    """Makes the cases of all kernels, by name; intermediate inputs have the memory layout of the chosen version."""
    with kernel_version(choice):
        return _make_cases()


def _make_cases() -> dict[str, Case]:
    torch.manual_seed(0)
    bounded, unbounded = make_converging_rays(), make_converging_rays()
    origins, directions, aabb = bounded[:3]
    packed = tuple(march(False, None, *bounded))
    t, dt, ray, _ = packed
    capacity = 5 * len(t) // 4  # as samplers choose it to avoid a host sync
    packed_into_capacity = tuple(march(False, capacity, *bounded))
    density = 100 * torch.rand(len(t)) ** 3  # some transparent, some opaque
    optical_depth = density[torch.arange(capacity) % len(t)] * packed_into_capacity[1]
    rgb = torch.rand(3, len(t)).T
    unit = Bounds(aabb).to_unit(kernels.ray_positions(origins, directions, ray, t))[:NUM_SAMPLES]
    view_directions = directions[ray][:NUM_SAMPLES]
    harmonics = kernels.spherical_harmonics(view_directions)
    grid, picture = HashGrid(cubic_cells(8, 16, 256), 17, 2), HashGrid2DField((512, 512)).grid
    layers = [torch.nn.Linear(i, o) for i, o in ((31, 32), (32, 32), (32, 3))]
    flat = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
    features = torch.rand(15, len(unit)).T
    clear = avoid_kinks(features, harmonics, layers)
    factors, colors = ((x.planes, x.lines) for x in (VectorMatrix(128, 16), VectorMatrix(128, 16)))
    voxels = VoxelField(Bounds(aabb), base_resolution=64, max_resolution=64, stages=1)
    sparsify(voxels)
    rows, weights = kernels.locate_vertices(voxels.index, unit)
    gathered, lattice = (rows, weights, harmonics[:, 1:4]), (voxels.log_density, voxels.vertex_of_row, voxels.index)
    marks, uv = torch.zeros(GRID_RESOLUTION**3, dtype=torch.int32), torch.rand(NUM_SAMPLES, 2)
    return {
        "march": Case(partial(march, False, None), bounded, kind="packed"),
        "march, unbounded": Case(partial(march, True, None), unbounded, kind="packed"),
        "march, into capacity": Case(partial(march, False, capacity), bounded, kind="packed"),
        "ray_positions": Case(kernels.ray_positions, (origins, directions, ray, t)),
        "filter_visible": Case(partial(filter_visible, None), (density * packed[1], *packed), kind="packed"),
        "filter_visible, into capacity": Case(
            partial(filter_visible, capacity), (optical_depth, *packed_into_capacity), kind="packed"
        ),
        "merge_low_weight": Case(merge_low_weight, (density * packed[1], *packed), kind="packed"),
        "mark_cells": Case(mark_cells, (marks, aabb, kernels.ray_positions(origins, directions, ray, t))),
        "hash_interpolate": Case(partial(hash_interpolate, grid), (grid.tables, unit), num_trainable=1),
        "hash_interpolate_2d": Case(partial(hash_interpolate, picture), (picture.tables, uv), num_trainable=1),
        "mlp": Case(mlp, (features.T[:, clear].T, *flat, harmonics.T[:, clear].T), num_trainable=1 + len(flat)),
        "spherical_harmonics": Case(kernels.spherical_harmonics, (view_directions,)),
        "plane_line_products": Case(kernels.plane_line_products, (*factors, unit), num_trainable=2),
        "plane_line_sum": Case(kernels.plane_line_sum, (*factors, unit), num_trainable=2),
        "plane_line_sum_and_products": Case(plane_line_sum_and_products, (*factors, *colors, unit), num_trainable=4),
        "locate_vertices": Case(kernels.locate_vertices, (voxels.index, unit), kind="rows"),
        "mark_rows": Case(mark_rows, (voxels.last_read_step, rows)),
        "interpolate_voxels": Case(kernels.interpolate_voxels, (*voxels.tables, *gathered), num_trainable=3),
        "interpolate_scalar": Case(kernels.interpolate_scalar, (voxels.log_density, voxels.index, unit)),
        "total_variation": Case(total_variation, lattice, num_trainable=1),
        "composite": Case(kernels.composite, (density, rgb, *packed), num_trainable=2),
    }
