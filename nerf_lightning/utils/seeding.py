"""Random numbers that depend only on (seed, stream, step), so that a resumed run draws what an uninterrupted one would."""

from enum import IntEnum

import torch

_SEED_MULTIPLIER = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: consecutive steps land far apart in the seed space


class Stream(IntEnum):
    """Each use of random numbers draws from a stream of its own. Changing a number changes what is drawn."""

    BATCH = 0
    """Which rays or pixels a step trains on."""
    STEP = 1
    """Jitter, random backgrounds and occupancy updates within a step."""
    BASELINE = 2
    """Pixels that the error of one plain colour is measured on."""
    RESTART = 3
    """Fresh weights after a breakdown."""
    ANALYSIS = 4
    """Experiments on a scene or a trained field: damage, other samplers."""
    REFINEMENT_TRIAL = 5
    """Pixels that decide whether cameras and light are corrected."""


def step_generator(seed: int, stream: Stream, step: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A fresh generator for one step of one stream."""
    mixed = ((seed * 1_000_003 + stream) * _SEED_MULTIPLIER + step * 0xBF58476D1CE4E5B9) & (2**63 - 1)
    # The CPU's generator uses only the low half.
    return torch.Generator(device).manual_seed(mixed ^ (mixed >> 32))
