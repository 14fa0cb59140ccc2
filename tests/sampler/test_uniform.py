from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.sampler import UniformSampler


def nowhere(positions: Tensor) -> Tensor:
    raise AssertionError("a uniform sampler does not ask the field")


def seeded(seed: int = 3) -> Generator:
    return Generator().manual_seed(seed)


@pytest.mark.parametrize("count", [1, 17])
def test_uniform_sampler_takes_equal_steps(count: int, box: Bounds, rays: Rays):
    samples = UniformSampler(box, count)(rays, nowhere)
    near, far = box.near_far(rays)
    assert 0 < int((near < far).sum()) < len(rays), "some hit, some miss"
    for r in range(len(rays)):
        part = slice(int(samples.offsets[r]), int(samples.offsets[r + 1]))
        length = float(far[r] - near[r])
        if length <= 0:
            assert part.start == part.stop
            continue
        assert samples.ray[part].tolist() == [r] * count
        torch.testing.assert_close(samples.dt[part], torch.full((count,), length / count), rtol=1e-4, atol=1e-5)
        middle = near[r] + length * (torch.arange(count) + 0.5) / count
        torch.testing.assert_close(samples.t[part], middle, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("count", "unbounded"), [(1, False), (16, False), (16, True)])
def test_uniform_sampler_jitter_stays_in_stratum(count: int, unbounded: bool, box: Bounds, rays: Rays):
    bounds = replace(box, unbounded=unbounded)
    sampler = UniformSampler(bounds, count, stratified=True)
    near, far = bounds.near_far(rays)
    rays, near, far = (x[near < far] for x in (rays, near, far))
    even = torch.linspace(0, 1, count + 1).expand(len(rays), -1)
    strata = bounds.distances(rays, near, far, (even[:, 1:] + even[:, :-1]) / 2)
    jittered = torch.stack([sampler.edges(rays, seeded(i)) for i in range(50)])
    torch.testing.assert_close(jittered[0][:, [0, -1]], sampler.edges(rays, None)[:, [0, -1]])
    inner = jittered[:, :, 1:-1]
    assert (inner >= strata[:, :-1] - 1e-4).all() and (inner <= strata[:, 1:] + 1e-4).all()
    if count > 1:  # and uses the whole of it
        share = (inner - strata[:, :-1]) / strata.diff(dim=1)
        assert share.amin() < 0.05 and share.amax() > 0.95
        if not unbounded:
            assert abs(float(share.mean()) - 0.5) < 0.05
