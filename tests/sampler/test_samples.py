from dataclasses import replace

import pytest
import torch

from nerf_lightning.sampler import pack, split_by_rays


def test_pack_mask_keeps_intervals_in_ray_order():
    edges = torch.rand(13, 8).cumsum(1)
    keep = torch.rand(13, 7) < 0.5
    t, dt, ray, offsets = [], [], [], [0]
    for r in range(13):
        for i in range(7):
            if keep[r, i]:
                start, end = float(edges[r, i]), float(edges[r, i + 1])
                t.append((start + end) / 2)
                dt.append(end - start)
                ray.append(r)
        offsets.append(len(t))
    samples = pack(edges, keep)
    assert len(samples) == len(t)
    assert samples.ray.tolist() == ray and samples.offsets.tolist() == offsets
    torch.testing.assert_close(samples.t, torch.tensor(t))
    torch.testing.assert_close(samples.dt, torch.tensor(dt), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("max_samples", [1, 7, 1000])
def test_split_by_rays_any_size_yields_complete_rays(max_samples: int):
    keep = torch.rand(40, 6) < 0.5
    keep[7:10] = False
    keep[13] = True
    edges = torch.rand(40, 7).sort(dim=1).values
    samples = pack(edges, keep)
    rays, t, ray = [], [], []
    for run, part in split_by_rays(samples, max_samples):
        counts = part.offsets.diff()
        assert len(part) <= max_samples or len(counts) == 1
        assert torch.equal(part.ray, torch.arange(len(counts)).repeat_interleave(counts))
        rays += range(run.start, run.stop)
        t.append(part.t)
        ray.append(part.ray + run.start)
    assert rays == list(range(40))
    assert torch.equal(torch.cat(t), samples.t)
    assert torch.equal(torch.cat(ray), samples.ray)


def test_clip_and_split_select_values_of_each_sample():
    samples = pack(torch.rand(40, 7).sort(dim=1).values, torch.rand(40, 6) < 0.7)
    samples = replace(samples, cached_positions=samples.t[:, None].expand(-1, 3), optical_depth=2 * samples.t)
    for part in (samples.clip(0.3, 0.6), *(part for _, part in split_by_rays(samples, 20))):
        assert len(part) and torch.equal(part.optical_depth, 2 * part.t)
        assert torch.equal(part.cached_positions, part.t[:, None].expand(-1, 3))
