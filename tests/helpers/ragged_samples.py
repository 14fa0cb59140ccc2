"""Samples for tests: rays that hold different counts, or none."""

import torch

from nerf_lightning.sampler import Samples

SAMPLE_COUNTS = [[4], [3, 0, 5, 1], [0, 0, 7, 0], [0], [1] * 6, [30, 0, 2, 11, 0]]
BUNDLE = [int(n) for n in torch.randint(0, 40, (150,), generator=torch.Generator().manual_seed(1))]
"""How many samples the rays hold."""


def make_ragged_samples(counts: list[int], dtype: torch.dtype = torch.float32) -> Samples:
    """Touching intervals of random lengths, the given number on each ray, from t = 1 on."""
    dt = 0.05 + 0.2 * torch.rand(sum(counts), dtype=dtype)
    ray = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts, dtype=torch.int64))
    offsets = torch.tensor([0, *counts]).cumsum(0)
    end = torch.cat([1 + part.cumsum(0) for part in dt.split(counts)]) if counts else dt
    return Samples(end - dt / 2, dt, ray, offsets)
