"""Training state shared by the system and its callbacks: progress, learning-rate scale and clock."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

from nerf_lightning.utils.device import CPU, synchronize
from nerf_lightning.utils.machine import CpuLoad


class TrainingClock:
    """Training time: wall-clock seconds from the first step on, without `pause()` blocks."""

    def __init__(self) -> None:
        self.has_started = False
        """Whether training has started or resumed."""
        self.load = CpuLoad()
        """CPU use of this process and of others while the clock ran."""
        self._device = CPU
        self._elapsed = 0.0  # up to the last pause or restart
        self._start_time: float | None = None

    @property
    def seconds(self) -> float:
        """Seconds trained so far."""
        return self._elapsed if self._start_time is None else self._elapsed + time.perf_counter() - self._start_time

    def set_seconds(self, seconds: float) -> None:
        """Restores the seconds of a checkpoint."""
        self._elapsed = seconds

    def start(self, device: torch.device) -> None:
        """Starts the clock for training on a device."""
        self.has_started, self._device = True, device
        self._resume()

    def _resume(self) -> None:
        synchronize(self._device)
        self.load.start()
        self._start_time = time.perf_counter()

    def stop(self) -> None:
        synchronize(self._device)  # work still queued on the device counts as training
        self._elapsed, self._start_time = self.seconds, None
        self.load.stop()

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Pauses the clock for work that is not training."""
        is_running = self._start_time is not None
        self.stop()
        try:
            yield
        finally:
            if is_running:
                self._resume()


@dataclass
class TrainingState:
    """Progress of training, learning-rate scale and clock."""

    progress: float = 0.0
    """Fraction of the training done."""
    lr_scale: float = 1.0
    """Factor on all learning rates, on top of their schedule."""
    clock: TrainingClock = field(default_factory=TrainingClock)

    def set_progress(self, progress: float) -> None:
        self.progress = progress

    def set_lr_scale(self, factor: float) -> None:
        self.lr_scale = factor
