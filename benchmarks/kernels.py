"""Each kernel's fast version against its plain-torch reference, on the work of one training step."""

import time
from collections.abc import Callable
from statistics import median

import torch
from torch import Tensor

from nerf_lightning import kernels
from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.model import HashGrid, VectorMatrix, VoxelField

SAMPLES, RAYS = 1 << 15, 1 << 12


def milliseconds(work: Callable[[], object], rounds: int = 15) -> float:
    """Median time of a call, after two to warm up."""
    work(), work()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return 1e3 * median(times)


def with_gradient(work: Callable[[], Tensor]) -> Callable[[], None]:
    """The same work and its gradient."""

    def both() -> None:
        out = work()
        out.backward(torch.ones_like(out))

    return both


def rays_and_samples() -> tuple[Rays, Bounds, tuple[Tensor, ...]]:
    """Rays from a sphere of radius 4 toward the middle of a box, and their samples where a ball of cells is occupied."""
    torch.manual_seed(0)
    origins = 4 * torch.nn.functional.normalize(torch.randn(RAYS, 3), dim=1)
    directions = torch.nn.functional.normalize(0.5 * torch.randn(RAYS, 3) - origins, dim=1)
    rays, bounds = Rays(origins, directions), Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    near, far = bounds.near_far(rays)
    axis = (torch.arange(64) + 0.5) / 32 - 1
    ball = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2 < 0.1).flatten()
    return rays, bounds, (near, far, torch.rand(RAYS), ball)


def cases() -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """Name -> (fast, reference)."""
    rays, bounds, (near, far, shift, ball) = rays_and_samples()
    march = rays, bounds, near, far, shift, ball, 192, 3.46 / 192
    packed = kernels.march(*march)
    t, dt, ray, offsets = packed
    density, rgb = torch.rand(len(t), requires_grad=True), torch.rand(3, len(t)).T.requires_grad_()
    positions = kernels.points(rays.origins, rays.directions, ray, t)
    unit = bounds.to_unit(positions)[:SAMPLES]
    grid = HashGrid()
    directions = rays.directions[ray][:SAMPLES]
    harmonics = kernels.spherical_harmonics(directions)
    features = torch.rand(15, len(unit)).T.requires_grad_()
    nets = [torch.nn.Linear(i, o) for i, o in ((31, 32), (32, 32), (32, 3))]
    layers = [(net.weight, net.bias) for net in nets]
    table = grid.tables, unit, grid.resolutions, grid.sizes
    volume = density, rgb, t, dt, ray, offsets
    factors = VectorMatrix(128, 16)
    voxels = VoxelField(bounds, coarsest=64, finest=64, stages=1)
    found, view = kernels.locate(voxels.index, unit), harmonics[:, 1:4]
    found_reference = kernels.locate_reference(voxels.index, unit)
    run = voxels.log_density, voxels.vertex, voxels.index, 1, len(voxels.vertex)
    return {
        "march": (lambda: kernels.march(*march), lambda: kernels.march_reference(*march)),
        "points": (
            lambda: kernels.points(rays.origins, rays.directions, ray, t),
            lambda: kernels.points_reference(rays.origins, rays.directions, ray, t),
        ),
        "keep_visible": (
            lambda: kernels.keep_visible(density, packed, 1e-4, 5e-3),
            lambda: kernels.keep_visible_reference(density, packed, 1e-4, 5e-3),
        ),
        "hash_interpolate": (
            lambda: kernels.hash_interpolate(*table).detach(),
            lambda: kernels.hash_interpolate_reference(*table).detach(),
        ),
        "hash_interpolate + gradient": (
            with_gradient(lambda: kernels.hash_interpolate(*table)),
            with_gradient(lambda: kernels.hash_interpolate_reference(*table)),
        ),
        "mlp": (
            lambda: kernels.mlp(features, layers, harmonics).detach(),
            lambda: kernels.mlp_reference(features, layers, harmonics).detach(),
        ),
        "mlp + gradient": (
            with_gradient(lambda: kernels.mlp(features, layers, harmonics)),
            with_gradient(lambda: kernels.mlp_reference(features, layers, harmonics)),
        ),
        "spherical_harmonics": (
            lambda: kernels.spherical_harmonics(directions),
            lambda: kernels.spherical_harmonics_reference(directions),
        ),
        "plane_line_products + gradient": (
            with_gradient(lambda: kernels.plane_line_products(factors.planes, factors.lines, unit)),
            with_gradient(lambda: kernels.plane_line_products_reference(factors.planes, factors.lines, unit)),
        ),
        "locate": (
            lambda: kernels.locate(voxels.index, unit),
            lambda: kernels.locate_reference(voxels.index, unit),
        ),
        "read_voxels + gradient": (
            with_gradient(lambda: kernels.read_voxels(*voxels.tables, *found, view)[1]),
            with_gradient(lambda: kernels.read_voxels_reference(*voxels.tables, *found_reference, view)[1]),
        ),
        "roughness + gradient": (
            with_gradient(lambda: kernels.roughness(*run)),
            with_gradient(lambda: kernels.roughness_reference(*run)),
        ),
        "composite + gradient": (
            with_gradient(lambda: kernels.composite(*volume)[0]),
            with_gradient(lambda: kernels.composite_reference(*volume)[0]),
        ),
    }


def measure() -> list[dict[str, float | str]]:
    """Milliseconds of each kernel, fast and reference."""
    rows: list[dict[str, float | str]] = []
    for name, (fast, reference) in cases().items():
        ours, plain = milliseconds(fast), milliseconds(reference)
        rows.append({"kernel": name, "fast_ms": ours, "reference_ms": plain, "times_faster": plain / ours})
    return rows
