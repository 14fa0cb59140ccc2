"""Each kernel's fast version against its plain-torch reference, on the work of one training step."""

import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.cases import Case, cases, versions
from nerf_lightning.utils.device import CPU, synchronize

ROUNDS = 15


def milliseconds(work: Callable[[], object], device: torch.device) -> float:
    """Median time of a call, after two to warm up."""
    work(), work()
    times = []
    for _ in range(ROUNDS):
        synchronize(device)
        start = time.perf_counter()
        work()
        synchronize(device)
        times.append(time.perf_counter() - start)
    return 1e3 * median(times)


def random_like(outputs: list[Tensor]) -> list[Tensor]:
    """The same normal numbers on every device, laid out in memory as the outputs are."""
    generator = torch.Generator().manual_seed(7)
    return [torch.empty_like(x).copy_(torch.randn(x.shape, generator=generator)) for x in outputs]


def case_milliseconds(case: Case, device: torch.device, choice: str, gradient: bool) -> float:
    """Of one version of a kernel on a device, with or without the gradient."""
    with versions(choice), torch.set_grad_enabled(gradient):
        inputs = case.on(device)
        above = random_like(case.outputs(inputs))

        def work() -> None:
            outputs = case.outputs(inputs)
            if gradient:
                case.gradients(inputs, outputs, above)

        return milliseconds(work, device)


def measure() -> list[dict[str, Any]]:
    """Milliseconds of each kernel on the CPU, fast and reference."""
    rows = []
    choices = {choice: cases(choice) for choice in ("auto", "reference")}
    for name, case in choices["auto"].items():
        for gradient in (False, True) if case.learns else (False,):
            ours, plain = (case_milliseconds(made[name], CPU, choice, gradient) for choice, made in choices.items())
            row = {"kernel": f"{name} + gradient" if gradient else name, "fast_ms": ours, "reference_ms": plain}
            rows.append({**row, "times_faster": plain / ours})
    return rows
