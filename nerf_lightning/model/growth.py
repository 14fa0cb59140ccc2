"""When a grid is upsampled during training, and its parameters of another shape."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ResolutionSchedule:
    """The stages of a field that is upsampled during training, as fractions of it.

    Args:
        resolutions: cells along a side, one for each stage.
        starts: share of the training at which each stage begins; the first is 0.
        min_steps: steps before which the last stage does not begin, whatever the budget: earlier ones need them.
        max_steps: steps after which it begins, whatever the budget: earlier ones have learned what they can by then.
    """

    resolutions: Sequence[int]
    starts: Sequence[float]
    min_steps: int = 0
    max_steps: float = math.inf

    @property
    def end(self) -> float:
        """Share of the training at which the last stage begins."""
        return self.starts[-1]

    def stage_at(self, progress: float) -> int:
        """The stage after this share of the training."""
        return max(stage for stage, start in enumerate(self.starts) if progress >= start)

    def clamp_progress(self, progress: float, step: int, allow_shortening: bool = True) -> float:
        """The share of the training to take the stage of, after `step` steps of which only few or many fitted into it.

        Args:
            progress: share of the training done.
            step: steps done.
            may_hurry: whether `max_steps` counts.
        """
        if allow_shortening:
            progress = max(progress, self.end * min(1.0, step / self.max_steps))
        return min(progress, self.end * step / self.min_steps) if step < self.min_steps else progress


def replace_data(parameter: torch.nn.Parameter, data: Tensor) -> None:
    """Gives a parameter data of another shape. Modules and optimisers keep the same parameter."""
    parameter.grad = None
    # Autograd remembers a parameter's shape while a graph that used it lives; a change of type makes it forget.
    parameter.data = data.new_empty(0, dtype=torch.float16)
    parameter.data = data
