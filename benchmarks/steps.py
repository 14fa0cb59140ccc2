"""What a training step of the shipped size costs on a device: time, operations, waits of the host, memory."""

import tempfile
from pathlib import Path
from statistics import fmean, median
from typing import Any

import torch

from benchmarks.alike import FAILURES, Rows, told
from benchmarks.bare import bare_step
from benchmarks.count import Count
from benchmarks.setup import METHODS, built
from nerf_lightning.callbacks.results import peak_memory_bytes

WARMUP, PERIODS = 320, 6
"""Steps before the first that counts, and how many periods of the sampler's updates are timed after it."""
PROGRESS = 0.5
"""Reached at the end of the warm-up: fields have their full size then."""


def forget_peak(device: torch.device) -> None:
    """Begins to count the device's memory anew, where it can."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    elif device.type == "mps":
        torch.mps.empty_cache()


def of_method(overrides: list[str], device: torch.device) -> dict[str, Any]:
    """One line. Operations and waits are counted step by step over a whole period of the sampler's updates."""
    with tempfile.TemporaryDirectory() as folder:
        forget_peak(device)
        cfg, data, system = built(overrides, Path(folder), device)
    system.sampler.look_through(data.scene.train.cameras)
    optimizer = system.configure_optimizers()
    period = int(cfg.sampler.update_every)
    first = -(-WARMUP // period) * period

    def step(number: int) -> float:
        return bare_step(system, data, optimizer, number, PROGRESS * min(1.0, number / first))

    for number in range(first):
        step(number)
    counts = []
    for number in range(first, first + period):
        with Count() as count:
            step(number)
        counts.append((count.operations, count.waits))
    times, samples, rays = [], [], []
    for number in range(first + period, first + (1 + PERIODS) * period):
        times.append(1e3 * step(number))
        if system.stats.counted:
            samples.append(system.stats.samples)
        rays.append(system.stats.rays)
    between, whole = counts[1:] or counts, counts  # the first step of a period updates the sampler
    return {
        "scene": data.scene.name,
        "step_ms": median(times),
        "operations": median(operations for operations, _ in between),
        "waits": median(waits for _, waits in between),
        "operations_on_average": fmean(operations for operations, _ in whole),
        "waits_on_average": fmean(waits for _, waits in whole),
        "samples": fmean(samples) if samples else None,
        "rays": fmean(rays),
        "peak_memory_bytes": peak_memory_bytes(device),
    }


def measure(device: torch.device, overrides: list[str]) -> tuple[Rows, list[str]]:
    """The table, a line a method, and the methods that fail, with how."""
    rows: Rows = []
    failed = []
    for number, name in enumerate(METHODS, 1):
        words = f"steps {number}/{len(METHODS)}: {name}"
        print(f"{words}: {WARMUP} steps until it has its full size, then {PERIODS} rounds", flush=True)
        try:
            row = of_method(["+experiment=lego", f"recipe={name}_medium", *overrides], device)
            print(f"{words}: {row['step_ms']:.3g} ms, {row['operations']:.0f} operations", flush=True)
        except FAILURES as error:
            row = {"failed": told(error)}
            failed.append(f"{name} (a step of full size {told(error)})")
            print(f"{words}: {told(error)}", flush=True)
        rows.append({"method": name, **row})
    return rows, failed
