"""Random numbers that depend on nothing but (seed, stream, step), so that a resumed run draws what an unbroken one would."""

import torch

_MIX = 0x9E3779B97F4A7C15  # 2^64 / golden ratio: consecutive steps land far apart in the seed space


def step_generator(seed: int, stream: int, step: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A fresh generator for one step. `stream` keeps consumers apart (data 0, model 1)."""
    mixed = ((seed * 1_000_003 + stream) * _MIX + step * 0xBF58476D1CE4E5B9) & (2**63 - 1)
    # The CPU's generator looks at the low half alone.
    return torch.Generator(device).manual_seed(mixed ^ (mixed >> 32))
