"""Cutting samples into runs of whole rays."""

import pytest
import torch

from nerf_lightning.sampler import pack, split


@pytest.mark.parametrize("most", [1, 7, 1000])
def test_split_any_size_holds_whole_rays(most: int):
    keep = torch.rand(40, 6) < 0.5
    keep[7:10] = False
    keep[13] = True
    edges = torch.rand(40, 7).sort(dim=1).values
    samples = pack(edges, keep)
    rays, t, ray = [], [], []
    for run, part in split(samples, most):
        counts = part.offsets.diff()
        assert len(part) <= most or len(counts) == 1
        assert torch.equal(part.ray, torch.arange(len(counts)).repeat_interleave(counts))
        rays += range(run.start, run.stop)
        t.append(part.t)
        ray.append(part.ray + run.start)
    assert rays == list(range(40))
    assert torch.equal(torch.cat(t), samples.t)
    assert torch.equal(torch.cat(ray), samples.ray)
