"""Machine description and background CPU load, which timings depend on."""

import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import psutil
import torch

MAX_BACKGROUND_LOAD = 0.1
"""Background load, as a fraction of a run's threads, above which timings are unreliable."""
MIN_LOAD_SECONDS = 0.5
"""Minimum duration of a load measurement: the system counts in 0.01 s."""


def available_cores() -> int:
    """CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor_name() -> str:
    """The CPU model, if the system knows it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # only Linux has it
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def accelerator_name(device: torch.device) -> str | None:
    """The accelerator's name, or its device type if unknown; None for the CPU."""
    if device.type == "cpu":
        return None
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return device.type


def describe_device(device: torch.device) -> str:
    """The device for messages: "cpu" or "cuda (NVIDIA H100)"."""
    name = accelerator_name(device)
    return device.type if name in (None, device.type) else f"{device.type} ({name})"


def describe_machine(device: torch.device) -> dict[str, Any]:
    """The machine, for results.json."""
    return {"processor": processor_name(), "cores": available_cores(), "accelerator": accelerator_name(device)}


def background_load(results: Mapping[str, Any]) -> float | None:
    """Fraction of a run's threads taken by other processes beyond the idle cores; None if unknown."""
    try:
        threads, cores = float(results["threads"]), float(results["machine"]["cores"])
        others = float(results["load"]["others"])
    except (KeyError, TypeError, ValueError):  # not measured, or a damaged file
        return None
    return max(0.0, others - max(0.0, cores - threads)) / max(threads, 1.0)


def _busy_seconds() -> float:
    """Non-idle CPU seconds of all cores since boot."""
    times = psutil.cpu_times()
    idle = times.idle + getattr(times, "iowait", 0.0)
    guests = getattr(times, "guest", 0.0) + getattr(times, "guest_nice", 0.0)  # already part of the user time
    return sum(times) - idle - guests


class CpuLoad:
    """CPU time used between `start` and `stop` by this process and by others."""

    def __init__(self) -> None:
        self.seconds = self.own = self.others = 0.0
        self._started: tuple[float, float, float] | None = None

    @staticmethod
    def _read_clocks() -> tuple[float, float, float]:
        return time.perf_counter(), time.process_time(), _busy_seconds()

    def start(self) -> None:
        self._started = self._read_clocks()

    def stop(self) -> None:
        """Accumulates the time since `start`, if it was called."""
        if self._started is None:
            return
        wall, own, busy = (now - then for now, then in zip(self._read_clocks(), self._started, strict=True))
        self._started = None
        self.seconds, self.own, self.others = self.seconds + wall, self.own + own, self.others + busy - own

    def average_cores(self) -> dict[str, float] | None:
        """Average number of busy cores; None if less than `MIN_LOAD_SECONDS` were measured."""
        if self.seconds < MIN_LOAD_SECONDS:
            return None
        return {"own": round(self.own / self.seconds, 3), "others": round(max(0.0, self.others) / self.seconds, 3)}
