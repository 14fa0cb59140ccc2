"""The state of a training run that the system and its callbacks share: progress, learning-rate scale and clock."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import torch

from nerf_lightning.utils.device import CPU, synchronize
from nerf_lightning.utils.machine import Load, work_clocks

WORK_STEPS, WORK_QUANTILE = 20, 0.1
"""With `by_work`: steps that are looked back on, and the share of them that other work never disturbs: each time it has a core
in between, it leaves this process's data out of the caches too."""


class TrainingClock:
    """Seconds of training: the wall clock from the first step on, less what runs inside `paused()`."""

    def __init__(self) -> None:
        self.started = False
        """Whether training has begun, or gone on."""
        self.load = Load()
        """CPU use of this process and of others while the clock ran."""
        self._by_work = False
        self._device = CPU
        self._elapsed = 0.0  # up to the last pause or restart
        self._since: float | None = None
        self._work = (0.0, 0.0)  # `work_clocks` when the step began
        self._step_seconds: deque[float] = deque(maxlen=WORK_STEPS)

    @property
    def seconds(self) -> float:
        """Trained so far."""
        if self._since is None or self._by_work:
            return self._elapsed
        return self._elapsed + time.perf_counter() - self._since

    def set_seconds(self, seconds: float) -> None:
        """Goes on from a time that a checkpoint kept."""
        self._elapsed = seconds

    def start(self, device: torch.device, by_work: bool = False) -> None:
        """Starts.

        Args:
            device: that trains.
            by_work: whether a step on a CPU counts as long as its threads work on one that nothing disturbs, however long they
                wait for a core.
        """
        self.started, self._device, self._by_work = True, device, by_work and device.type == "cpu"
        self._resume()

    def _resume(self) -> None:
        synchronize(self._device)
        self.load.start()
        self._since, self._work = time.perf_counter(), work_clocks(torch.get_num_threads())

    def stop(self) -> None:
        synchronize(self._device)  # work still queued on the device counts as training
        self._elapsed, self._since = self.seconds, None
        self.load.stop()

    def count_step(self) -> None:
        """Called after each step, for a clock that goes on by work."""
        if not self._by_work:
            return
        now = work_clocks(torch.get_num_threads())
        self._step_seconds.append(max(a - b for a, b in zip(now, self._work, strict=True)))
        self._work = now
        self._elapsed += sorted(self._step_seconds)[round(WORK_QUANTILE * (len(self._step_seconds) - 1))]

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stops for work that is not training."""
        is_running = self._since is not None
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

    def advance(self, progress: float) -> None:
        """Sets the share of the training done."""
        self.progress = progress

    def scale_lr(self, factor: float) -> None:
        """Sets the factor on all learning rates."""
        self.lr_scale = factor
