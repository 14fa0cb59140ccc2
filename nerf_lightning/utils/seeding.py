"""Random numbers that depend on nothing but (seed, stream, step), so that a resumed run draws what an unbroken one would."""

from enum import IntEnum

import torch

_MIX = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: consecutive steps land far apart in the seed space


class Stream(IntEnum):
    """What draws random numbers, each from a stream of its own. A new value changes what its runs draw."""

    BATCH = 0
    """Which rays or pixels a step trains on."""
    STEP = 1
    """Jitter, random backgrounds and looks at empty space within a step."""
    PLAIN = 2
    """The pixels that tell how well one plain colour would do."""
    RESTART = 3
    """Fresh weights after a breakdown."""
    STUDY = 4
    """What is done to a scene or a trained field to learn how they stand it."""


def step_generator(seed: int, stream: Stream, step: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A fresh generator for one step of one stream."""
    mixed = ((seed * 1_000_003 + stream) * _MIX + step * 0xBF58476D1CE4E5B9) & (2**63 - 1)
    # The CPU's generator looks at the low half alone.
    return torch.Generator(device).manual_seed(mixed ^ (mixed >> 32))
