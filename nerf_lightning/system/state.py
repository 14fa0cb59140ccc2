"""The state of a training run that the system and its callbacks share: progress, learning-rate scale and clock."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

from nerf_lightning.utils.device import CPU, synchronize
from nerf_lightning.utils.machine import CpuLoad


class TrainingClock:
    """Seconds of training: the wall clock from the first step on, less what runs inside `pause()`."""

    def __init__(self) -> None:
        self.has_started = False
        """Whether training has begun, or gone on."""
        self.load = CpuLoad()
        """CPU use of this process and of others while the clock ran."""
        self._device = CPU
        self._elapsed = 0.0  # up to the last pause or restart
        self._start_time: float | None = None

    @property
    def seconds(self) -> float:
        """Trained so far."""
        return self._elapsed if self._start_time is None else self._elapsed + time.perf_counter() - self._start_time

    def set_seconds(self, seconds: float) -> None:
        """Goes on from a time that a checkpoint kept."""
        self._elapsed = seconds

    def start(self, device: torch.device) -> None:
        """Starts, for training on a device."""
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
        """Stops for work that is not training."""
        is_running = self._start_time is not None
        self.stop()
        try:
            yield
        finally:
            if is_running:
                self._resume()


@dataclass
class TrainingState:
    """How far training is; given to the system and to the callbacks that steer it."""

    progress: float = 0.0
    """Share of the training done."""
    lr_scale: float = 1.0
    """Factor on all learning rates, besides their schedule."""
    clock: TrainingClock = field(default_factory=TrainingClock)

    def set_progress(self, progress: float) -> None:
        """Sets the share of the training done."""
        self.progress = progress

    def set_lr_scale(self, factor: float) -> None:
        """Sets the factor on all learning rates."""
        self.lr_scale = factor
