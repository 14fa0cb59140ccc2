"""Self-test: every GPU kernel against the PyTorch reference, in value and gradient, on the device that will run it."""

import functools
import logging
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.composite import composite_reference, filter_visible_reference
from nerf_lightning.kernels.hashgrid import hash_interpolate_reference
from nerf_lightning.kernels.march import Packed, march_reference
from nerf_lightning.kernels.vector_matrix import products_reference

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
    for name, (fast, reference, inputs, num_free) in make_checks(device).items():
        try:
            actual = compute_with_gradients(fast, inputs, num_free)
        except Exception as error:
            log.debug("self-test of %s", name, exc_info=True)
            yield name, f"{type(error).__name__}: {' '.join(str(error).split())}"
            continue
        yield name, max(map(relative_difference, actual, compute_with_gradients(reference, inputs, num_free)))


Check = tuple[Callable[..., Any], Callable[..., Any], list[Tensor], int]
"""Fast version, reference, their inputs, and how many of the first inputs get gradients."""


def make_checks(device: torch.device) -> dict[str, Check]:
    """Makes a check of each kernel, by name."""
    from nerf_lightning.kernels.gpu import composite, hashgrid, march, vector_matrix

    generator = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator).to(device)

    origins = 4 * normalize(rand(NUM_RAYS, 3) - 0.5, dim=1)
    rays, bounds = (
        Rays(origins, normalize(rand(NUM_RAYS, 3) - 0.5 - origins, dim=1)),
        Bounds(rand(2, 3) + 1 - torch.tensor([[2.0], [0.0]]).to(device)),
    )
    near, far = bounds.near_far(rays)
    limits = near, far, rand(NUM_RAYS), rand(RESOLUTION**3) < 0.5
    steps = NUM_STEPS, 4.0 / NUM_STEPS, CAPACITY
    packed = t, dt, ray, offsets = march_reference(rays, bounds, *limits, *steps)
    filter_limits = 1e-2, 0.02, CAPACITY, float("inf")
    cells, sizes = [(4, 4, 4), (40, 40, 40)], [125, 1024]
    unit = rand(NUM_POSITIONS, 3)
    return {
        "march": (
            lambda *limits: mask_padding(march.march(rays, bounds, *limits, *steps)),  # type: ignore[call-arg]
            lambda *limits: mask_padding(march_reference(rays, bounds, *limits, *steps)),  # type: ignore[call-arg]
            list(limits),
            0,
        ),
        "filter_visible": (
            lambda depth: mask_padding(composite.filter_visible(depth, packed, *filter_limits)[1]),
            lambda depth: mask_padding(filter_visible_reference(depth, packed, *filter_limits)[1]),
            [0.5 * rand(CAPACITY) ** 4],
            0,
        ),
        "composite": (
            lambda density, rgb: composite.Composite.apply(density, rgb, t, dt, offsets),
            lambda density, rgb: composite_reference(density, rgb, t, dt, ray, offsets),
            [20 * rand(CAPACITY), rand(CAPACITY, 3)],
            2,
        ),
        "hash_interpolate": (
            lambda tables, unit: [hashgrid.HashInterpolate.apply(tables, unit, cells, sizes)],
            lambda tables, unit: [hash_interpolate_reference(tables, unit, cells, sizes)],
            [rand(sum(sizes), 2), unit],
            2,
        ),
        "plane_line_products": (
            lambda planes, lines: [vector_matrix.PlaneLine.apply(planes, lines, unit, False)],
            lambda planes, lines: [products_reference((planes, lines), unit=unit)[0].flatten(1)],
            [rand(3, 20, 20, 16), rand(3, 20, 16)],
            2,
        ),
    }


def mask_padding(packed: Packed) -> list[Tensor]:
    """Intervals with zeros in the unused part of the buffer."""
    t, dt, ray, offsets = packed
    return [t * (dt > 0), dt, ray * (dt > 0), offsets]


def compute_with_gradients(function: Callable[..., Any], inputs: list[Tensor], num_free: int) -> list[Tensor]:
    """Outputs of a function, and the gradients of their sum of squares with respect to its first inputs."""
    free = [x.detach().requires_grad_() for x in inputs[:num_free]]
    outputs = list(function(*free, *inputs[num_free:]))
    gradients = torch.autograd.grad(sum(x.square().sum() for x in outputs), free) if free else ()
    return [*(x.detach() for x in outputs), *gradients]


def relative_difference(actual: Tensor, expected: Tensor) -> float:
    """Largest difference, relative to the largest expected value, or 1."""
    if actual.shape != expected.shape:
        return float("inf")
    return float((actual.detach() - expected.detach()).abs().max() / expected.abs().max().clamp_min(1))
