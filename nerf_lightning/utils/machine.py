"""The machine a run has, and how much of it other work took: without either, seconds mean little."""

import os
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil
import torch

CROWDED = 0.1
"""Share of a run's threads that other work may take before its seconds are called those of a busy machine."""
SHORTEST = 0.5
"""Seconds below which the system's clock, which counts in hundredths, tells nothing about a load."""


def cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def processor() -> str:
    """The processor's name, as far as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # there is none beyond Linux
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def accelerator(device: torch.device) -> str | None:
    """The name of the chip that does the work, or of its kind where nothing tells more; None for the processor itself."""
    if device.type == "cpu":
        return None
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type == "mps" and hasattr(torch.backends.mps, "get_name"):  # since PyTorch 2.8
        return torch.backends.mps.get_name()
    return device.type


def device_in_words(device: torch.device) -> str:
    """For people: cpu, or such as cuda (NVIDIA H100)."""
    name = accelerator(device)
    return device.type if name in (None, device.type) else f"{device.type} ({name})"


def describe_machine(device: torch.device) -> dict[str, Any]:
    """What seconds depend on, for results.json."""
    return {"processor": processor(), "cores": cores(), "accelerator": accelerator(device)}


def taken(cores: float, threads: float, others: float) -> float:
    """The share of a run's threads that other work took: what it used beyond the cores that the run left free."""
    return max(0.0, others - max(0.0, cores - threads)) / max(threads, 1.0)


def crowding(results: Mapping[str, Any]) -> float | None:
    """`taken` of a run, from its results.json; None where that does not tell it."""
    load, machine = results.get("load"), results.get("machine")
    if not isinstance(load, Mapping) or not isinstance(machine, Mapping):
        return None
    found = (machine.get("cores"), results.get("threads"), load.get("others"))
    figures = [figure for figure in found if isinstance(figure, int | float)]
    return taken(*figures) if len(figures) == len(found) else None


def _busy_seconds() -> float:
    """CPU seconds of all cores since the machine started that were not idle."""
    times = psutil.cpu_times()
    idle = times.idle + getattr(times, "iowait", 0.0)
    guests = getattr(times, "guest", 0.0) + getattr(times, "guest_nice", 0.0)  # counted in user time already
    return sum(times) - idle - guests


@dataclass
class Load:
    """CPU seconds spent between `start` and `stop`, by this process and by everything else."""

    seconds: float = 0.0
    """On the wall clock."""
    own: float = 0.0
    others: float = 0.0
    _since: tuple[float, float, float] | None = field(default=None, repr=False)

    @staticmethod
    def _now() -> tuple[float, float, float]:
        return time.perf_counter(), time.process_time(), _busy_seconds()

    def start(self) -> None:
        self._since = self._now()

    def stop(self) -> None:
        """Adds what has passed since `start`; without one, nothing."""
        if self._since is None:
            return
        wall, own, busy = (now - then for now, then in zip(self._now(), self._since, strict=True))
        self._since = None
        self.seconds += wall
        self.own += own
        self.others += busy - own  # may be below zero for a moment: the system counts in hundredths

    def cores(self) -> dict[str, float] | None:
        """Cores in use on average; None where too little time has passed to tell."""
        if self.seconds < SHORTEST:
            return None
        return {"own": round(self.own / self.seconds, 3), "others": round(max(0.0, self.others) / self.seconds, 3)}
