"""Random generators determined by (seed, stream, step), so that a resumed run draws what an uninterrupted one does."""

from enum import IntEnum

import torch

_SEED_MULTIPLIER = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: decorrelates consecutive steps


class Stream(IntEnum):
    """Independent random streams. Changing a number changes what is drawn."""

    BATCH = 0
    """Rays or pixels of a training step."""
    STEP = 1
    """Jitter, random backgrounds and occupancy updates within a step."""
    BASELINE = 2
    """Pixels for the error of a constant color."""
    RESTART = 3
    """New initial weights after divergence."""
    ANALYSIS = 4
    """Experiments on a scene or a trained field: corruptions, other samplers."""
    REFINEMENT_TRIAL = 5
    """Pixels that decide whether poses and exposures are refined."""


def step_generator(seed: int, stream: Stream, step: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A new generator for a step of a stream."""
    mixed = ((seed * 1_000_003 + stream) * _SEED_MULTIPLIER + step * 0xBF58476D1CE4E5B9) & (2**63 - 1)
    # The CPU's generator uses only the low half.
    return torch.Generator(device).manual_seed(mixed ^ (mixed >> 32))
