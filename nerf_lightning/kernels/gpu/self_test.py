"""Self-test: every GPU kernel against the PyTorch reference, in value and gradient, on the device that will run it."""

import functools
import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning import kernels
from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.backend import get_kernels, set_kernels
from nerf_lightning.kernels.march import Packed, march_reference

log = logging.getLogger(__name__)

MIN_TRITON = (3, 3)
MIN_CAPABILITY = (7, 5)
TOLERANCE = 1e-4
"""Largest difference, relative to a tensor's largest value or 1."""
NUM_RAYS, NUM_STEPS, CAPACITY, NUM_POSITIONS = 500, 100, 40_000, 2000
RESOLUTION = 16


@functools.cache
def is_passed(device: torch.device) -> bool:
    """Whether the GPU kernels work on a device; if not, logs why, once per process."""
    reason = find_obstacle(device) or find_failure(device)
    if reason:
        log.warning("no fast GPU kernels on %s, which runs plain PyTorch instead: %s", device, reason)
    return not reason


def find_obstacle(device: torch.device) -> str:
    """Why the kernels cannot be compiled for a device; "" if they can."""
    try:
        import triton
    except ImportError:
        return "Triton is not installed"
    if tuple(map(int, triton.__version__.split(".")[:2])) < MIN_TRITON:
        return f"Triton {triton.__version__} is older than {MIN_TRITON[0]}.{MIN_TRITON[1]}"
    if torch.cuda.get_device_capability(device) < MIN_CAPABILITY:
        return f"compute capability below {MIN_CAPABILITY[0]}.{MIN_CAPABILITY[1]}"
    return ""


def find_failure(device: torch.device) -> str:
    """Name of a kernel that fails or differs from the reference, and how; "" if there is none."""
    for name, difference in measure_differences(device):
        if isinstance(difference, str):
            return f"{name}: {difference}"
        if not difference <= TOLERANCE:
            return f"{name} differs from the reference by {difference:.1e}"
    return ""


def measure_differences(device: torch.device) -> Iterator[tuple[str, float | str]]:
    """Yields each kernel's name and its largest difference from the reference, or its error."""
    for name, (function, free) in make_checks(device).items():
        try:
            actual = compute_with_gradients("triton", function, free)
        except Exception as error:
            log.debug("self-test of %s", name, exc_info=True)
            yield name, f"{type(error).__name__}: {' '.join(str(error).split())}"
            continue
        yield name, max(map(relative_difference, actual, compute_with_gradients("reference", function, free)))


def make_checks(device: torch.device) -> dict[str, tuple[Callable[..., Any], list[Tensor]]]:
    """Functions by the name of their kernel, and the inputs with respect to which they are differentiated."""
    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator).to(device)

    def mark(positions: Tensor) -> list[Tensor]:
        kernels.mark_cells(marks := torch.zeros(RESOLUTION**3, device=device).int(), 1, bounds, positions)
        return [marks]

    def run_network(x: Tensor, *parameters: Any) -> tuple[Tensor, Tensor]:
        return kernels.mlp_heads(x, [parameters[:2], parameters[2:]], 1, bits[:, :16])

    origins = 4 * normalize(rand(NUM_RAYS, 3) - 0.5, dim=1)
    rays = Rays(origins, normalize(rand(NUM_RAYS, 3) - 0.5 - origins, dim=1))
    bounds = Bounds(rand(2, 3) + 1 - torch.tensor([[2.0], [0.0]]).to(device))
    limits = rand(NUM_RAYS), rand(RESOLUTION**3) < 0.5, NUM_STEPS, 4.0 / NUM_STEPS, CAPACITY
    packed = t, dt, ray, offsets = march_reference(rays, bounds, *limits)
    unit, planes, depth = rand(NUM_POSITIONS, 3), rand(3, 20, 20, 16), 0.5 * rand(CAPACITY) ** 4
    cells, sizes = [(4, 4, 4), (40, 40, 40)], [125, 1024]
    colors, alpha, pixels = rand(2, NUM_RAYS, 3), rand(NUM_RAYS), (255 * rand(NUM_RAYS, 4)).byte()
    weights = rand(NUM_RAYS), rand(NUM_RAYS) < 0.5
    bits = rand(NUM_POSITIONS, 32).round()  # sums of products of few bits are exact in TF32
    edges, shares, main = rand(NUM_RAYS, 25).sort(1).values, rand(NUM_RAYS, 24) + 0.1, rand(NUM_RAYS, 16) / 16
    room = replace(bounds, unbounded=True, core=0.3 * bounds.aabb)
    exact = march_reference(rays, bounds, *limits[:-1])
    penalties = exact, 0.5, (1.0, 1.0, 1.0), rand(NUM_RAYS)
    return {
        "march": (lambda: mask_padding(kernels.march(rays, bounds, *limits)), []),
        "filter_visible": (lambda: mask_padding(kernels.filter_visible(depth, packed, 1e-2, 0.02, CAPACITY)[1]), []),
        "ray_positions": (lambda: [kernels.ray_positions(rays.origins, rays.directions, ray, t)], []),
        "mark_cells": (lambda: mark(rays.origins / 2), []),
        "composite": (
            lambda a, b: kernels.composite(a, b, t, dt, ray, offsets),
            [20 * rand(CAPACITY), rand(CAPACITY, 3)],
        ),
        "photometric_loss": (
            lambda a, b: kernels.photometric_loss(a, b, colors[0], pixels, *weights, 0.1)[:2],
            [*colors[1:], alpha],
        ),
        "hash_interpolate": (lambda a, b: [kernels.hash_interpolate(a, b, cells, sizes)], [rand(sum(sizes), 2), unit]),
        "plane_line_products": (lambda a, b: [kernels.plane_line_products(a, b, unit)], [planes, planes[:, 0]]),
        "mlp": (run_network, [bits[:, 16:], *(rand(*n).round() for n in ((32, 32), (32,), (8, 32), (8,)))]),
        "interval_midpoints": (lambda: kernels.interval_midpoints(rays, room, *room.near_far(rays), edges), []),
        "resample": (lambda: [kernels.resample(edges, shares, limits[0] - 0.5, 16)], []),
        "proposal_weights": (lambda x: [kernels.proposal_weights(x, shares, -1.0, 0.5)], [rand(24 * NUM_RAYS, 2)]),
        "interlevel_loss": (lambda x: [kernels.interlevel_loss(x, edges, edges[:, :17], main)], [shares / 40]),
        "weight_losses": (
            lambda a, b: kernels.weight_losses(a, b, *penalties).values(),
            [rand(len(exact[0])), rand(len(exact[0]), 3)],
        ),
    }


def mask_padding(packed: Packed) -> list[Tensor]:
    """Intervals with zeros in the unused part of the buffer."""
    t, dt, ray, offsets = packed
    return [t * (dt > 0), dt, ray * (dt > 0), offsets]


def compute_with_gradients(choice: str, function: Callable[..., Any], inputs: list[Tensor]) -> list[Tensor]:
    """Outputs of a function with these kernels, and the gradients of the sum of the squares of those that have any."""
    free, before = [x.detach().requires_grad_() for x in inputs], get_kernels()
    set_kernels(choice)
    try:
        outputs = list(function(*free))
        loss = sum(x.square().sum() for x in outputs if x.requires_grad)
        return [*(x.detach() for x in outputs), *(torch.autograd.grad(loss, free) if free else ())]
    finally:
        set_kernels(before)


def relative_difference(actual: Tensor, expected: Tensor) -> float:
    """Largest difference, relative to the largest expected value, or 1."""
    if actual.shape != expected.shape:
        return float("inf")
    return float((actual.detach() - expected.detach()).abs().max() / expected.abs().max().clamp_min(1))
