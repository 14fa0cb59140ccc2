"""The kernels' work in one training step: what they are called with, and which of that gets a gradient."""

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

SAMPLES, RAYS = 1 << 15, 1 << 12
STEPS, CELLS = 192, 64
"""Steps along a ray at most, and cells along a side of the occupancy grid."""
TRANSPARENT, THIN, FAINT = 1e-4, 5e-3, 1e-2
KINK = 1e-5
"""Distance from zero that counts as near for a rectifier."""
GONE = 1 / 3
"""Share of the voxels' vertices that are not kept."""

Outputs = Sequence[Tensor]


@dataclass(frozen=True)
class Case:
    """A kernel as a training calls it; which version runs is for `use_kernels` and the inputs' device to say."""

    call: Callable[..., Tensor | Outputs]
    inputs: tuple[Tensor, ...]
    """On the CPU."""
    learns: int = 0
    """How many of the inputs, from the first, get a gradient."""
    kind: str = "dense"
    """What comes out: "dense" tensors of one size; "packed" samples, however many; "located" rows and their weights."""

    def on(self, device: torch.device) -> tuple[Tensor, ...]:
        """Fresh inputs there, those that learn as leaves."""
        copies = [x.detach().to(device, copy=True) for x in self.inputs]
        return tuple(x.requires_grad_() if number < self.learns else x for number, x in enumerate(copies))

    def outputs(self, inputs: tuple[Tensor, ...]) -> list[Tensor]:
        """What comes out, as a list."""
        out = self.call(*inputs)
        return [out] if isinstance(out, Tensor) else list(out)

    def gradients(self, inputs: tuple[Tensor, ...], outputs: list[Tensor], above: list[Tensor]) -> list[Tensor]:
        """Those of the inputs that learn, `above` being what the outputs' are; none where none does."""
        learning = inputs[: self.learns]
        return list(torch.autograd.grad(outputs, learning, above)) if learning else []


@contextmanager
def versions(choice: str) -> Iterator[None]:
    """What `use_kernels` says, for a while."""
    kernels.use_kernels(choice)
    try:
        yield
    finally:
        kernels.use_kernels("auto")


def march(unbounded: bool, room: int | None, *tensors: Tensor) -> Outputs:
    origins, directions, aabb, near, far, shift, occupied = tensors
    rays, bounds = Rays(origins, directions), Bounds(aabb, unbounded)
    return kernels.march(rays, bounds, near, far, shift, occupied, STEPS, 3.46 / STEPS, room)


def keep_visible(room: int | None, thickness: Tensor, *packed: Tensor) -> Outputs:
    t, dt, ray, offsets = packed
    return kernels.keep_visible(thickness, (t, dt, ray, offsets), TRANSPARENT, THIN, room)[1]


def merge_faint(thickness: Tensor, *packed: Tensor) -> Outputs:
    t, dt, ray, offsets = packed
    return kernels.merge_faint(thickness, (t, dt, ray, offsets), FAINT)[1]


def mark_cells(marks: Tensor, aabb: Tensor, positions: Tensor) -> Tensor:
    marks = marks.clone()
    kernels.mark_cells(marks, 3, Bounds(aabb), positions)
    return marks


def mark_rows(seen: Tensor, rows: Tensor) -> Tensor:
    seen = seen.clone()
    kernels.mark_rows(seen, rows, 3)
    return seen


def mlp(x: Tensor, *rest: Tensor) -> Tensor:
    """The layers' matrices and biases in turn, then the extra inputs."""
    *flat, extra = rest
    return kernels.mlp(x, list(zip(flat[::2], flat[1::2], strict=True)), extra)


def plane_line_sum_and_products(*tensors: Tensor) -> Outputs:
    planes, lines, others, other_lines, unit = tensors
    return kernels.plane_line_sum_and_products((planes, lines), (others, other_lines), unit)


def roughness(values: Tensor, vertex: Tensor, index: Tensor) -> Tensor:
    return kernels.roughness(values, vertex, index, 1, len(vertex))


def hash_interpolate(cells: Sequence[tuple[int, ...]], sizes: list[int], tables: Tensor, unit: Tensor) -> Tensor:
    return kernels.hash_interpolate(tables, unit, cells, sizes)


def toward_a_ball(unbounded: bool) -> tuple[Tensor, ...]:
    """Rays from a sphere of radius 4 toward the middle of a box, the box, where rays begin and end, their shifts, and a ball
    of occupied cells: what `march` takes."""
    origins = 4 * normalize(torch.randn(RAYS, 3), dim=1)
    directions = normalize(0.5 * torch.randn(RAYS, 3) - origins, dim=1)
    axis = (torch.arange(CELLS) + 0.5) / (CELLS / 2) - 1
    ball = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2 < 0.1).flatten()
    box = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), unbounded)
    return origins, directions, box.aabb, *box.near_far(Rays(origins, directions)), torch.rand(RAYS), ball


def sparse(field: VoxelField) -> None:
    """Leaves out some of a field's vertices, and gives the others something to tell."""
    keep = torch.rand(len(field.index)) > GONE
    rows = 1 + int(keep.sum())
    field.set_vertices(keep, [torch.randn(rows, *table.shape[1:]) for table in field.tables])


@torch.no_grad()
def clear_of_kinks(x: Tensor, extra: Tensor, layers: Sequence[torch.nn.Linear]) -> Tensor:
    """Rows of inputs at which no rectifier is so near to where it opens that rounding decides whether a gradient passes."""
    h, clear = torch.cat([x, extra], dim=1), torch.ones(len(x), dtype=torch.bool)
    for layer in layers[:-1]:
        before = layer(h)
        clear &= (before.abs() > KINK).all(1)
        h = torch.relu(before)
    return clear.nonzero()[:, 0]


def cases(choice: str = "reference") -> dict[str, Case]:
    """All kernels by name; what some take from others is laid out in memory as that version leaves it."""
    with versions(choice):
        return _cases()


def _cases() -> dict[str, Case]:
    torch.manual_seed(0)
    bounded, unbounded = (toward_a_ball(boundless) for boundless in (False, True))
    origins, directions, aabb = bounded[:3]
    packed = tuple(march(False, None, *bounded))
    t, dt, ray, _ = packed
    room = 5 * len(t) // 4  # as samplers leave where nobody waits to count
    roomy = tuple(march(False, room, *bounded))
    density = 100 * torch.rand(len(t)) ** 3  # some hold nothing, and some end their ray
    rgb = torch.rand(3, len(t)).T
    unit = Bounds(aabb).to_unit(kernels.points(origins, directions, ray, t))[:SAMPLES]
    seen_from = directions[ray][:SAMPLES]
    harmonics = kernels.spherical_harmonics(seen_from)
    grid, picture = HashGrid(cubic_cells(8, 16, 256), 17, 2), HashGrid2DField((512, 512)).grid
    layers = [torch.nn.Linear(i, o) for i, o in ((31, 32), (32, 32), (32, 3))]
    flat = [parameter for layer in layers for parameter in (layer.weight, layer.bias)]
    features = torch.rand(15, len(unit)).T
    clear = clear_of_kinks(features, harmonics, layers)
    factors, colours = VectorMatrix(128, 16), VectorMatrix(128, 16)
    voxels = VoxelField(Bounds(aabb), coarsest=64, finest=64, stages=1)
    sparse(voxels)
    rows, weights = kernels.locate(voxels.index, unit)
    marks = torch.zeros(CELLS**3, dtype=torch.int32)
    return {
        "march": Case(partial(march, False, None), bounded, kind="packed"),
        "march, unbounded": Case(partial(march, True, None), unbounded, kind="packed"),
        "march, into room": Case(partial(march, False, room), bounded, kind="packed"),
        "points": Case(kernels.points, (origins, directions, ray, t)),
        "keep_visible": Case(partial(keep_visible, None), (density * packed[1], *packed), kind="packed"),
        "keep_visible, into room": Case(
            partial(keep_visible, room), (density[torch.arange(room) % len(t)] * roomy[1], *roomy), kind="packed"
        ),
        "merge_faint": Case(merge_faint, (density * packed[1], *packed), kind="packed"),
        "mark_cells": Case(mark_cells, (marks, aabb, kernels.points(origins, directions, ray, t))),
        "hash_interpolate": Case(partial(hash_interpolate, grid.cells, grid.sizes), (grid.tables, unit), learns=1),
        "hash_interpolate_2d": Case(
            partial(hash_interpolate, picture.cells, picture.sizes),
            (picture.tables, torch.rand(SAMPLES, 2)),
            learns=1,
        ),
        "mlp": Case(mlp, (features.T[:, clear].T, *flat, harmonics.T[:, clear].T), learns=1 + len(flat)),
        "spherical_harmonics": Case(kernels.spherical_harmonics, (seen_from,)),
        "plane_line_products": Case(kernels.plane_line_products, (factors.planes, factors.lines, unit), learns=2),
        "plane_line_sum": Case(kernels.plane_line_sum, (factors.planes, factors.lines, unit), learns=2),
        "plane_line_sum_and_products": Case(
            plane_line_sum_and_products,
            (factors.planes, factors.lines, colours.planes, colours.lines, unit),
            learns=4,
        ),
        "locate": Case(kernels.locate, (voxels.index, unit), kind="located"),
        "mark_rows": Case(mark_rows, (voxels.seen, rows)),
        "read_voxels": Case(kernels.read_voxels, (*voxels.tables, rows, weights, harmonics[:, 1:4]), learns=3),
        "voxel_value": Case(kernels.voxel_value, (voxels.log_density, voxels.index, unit)),
        "roughness": Case(roughness, (voxels.log_density, voxels.vertex, voxels.index), learns=1),
        "composite": Case(kernels.composite, (density, rgb, *packed), learns=2),
    }
