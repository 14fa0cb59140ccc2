"""Coarse-to-fine schedule of grid resolutions, and replacement of parameters by others of another shape."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ResolutionSchedule:
    """Resolution stages of a field that is upsampled during training.

    Args:
        resolutions: cells along a side, one for each stage.
        starts: training progress in [0, 1] at which each stage begins; the first is 0.
        min_steps: minimum number of steps before the last stage, whatever the budget.
        max_steps: maximum number of steps before the last stage, whatever the budget: coarse stages converge by then.
    """

    resolutions: Sequence[int]
    starts: Sequence[float]
    min_steps: int = 0
    max_steps: float = math.inf

    @property
    def end(self) -> float:
        """Training progress at which the last stage begins."""
        return self.starts[-1]

    def stage_at(self, progress: float) -> int:
        """Stage at this training progress."""
        return max(stage for stage, start in enumerate(self.starts) if progress >= start)

    def clamp_progress(self, progress: float, step: int, allow_shortening: bool = True) -> float:
        """Growth progress in [0, 1]: `progress`, delayed by `min_steps` and advanced by `max_steps`.

        Args:
            progress: training progress in [0, 1].
            step: steps done.
            allow_shortening: whether `max_steps` applies.
        """
        if allow_shortening:
            progress = max(progress, self.end * min(1.0, step / self.max_steps))
        return min(progress, self.end * step / self.min_steps) if step < self.min_steps else progress


def replace_data(parameter: torch.nn.Parameter, data: Tensor) -> None:
    """Replaces a parameter's data by a tensor of another shape; modules and optimizers keep the parameter object."""
    parameter.grad = None
    # Autograd caches the parameter's shape while a graph uses it; assigning a tensor of another dtype first clears it.
    parameter.data = data.new_empty(0, dtype=torch.float16)
    parameter.data = data
