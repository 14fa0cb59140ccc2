"""Uniform, stratified and importance sampling."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import invert_cdf
from nerf_lightning.sampler import ImportanceSampler, UniformSampler


def no_density(positions: Tensor) -> Tensor:
    raise AssertionError("a uniform sampler does not ask the field")


def seeded(seed: int = 3) -> Generator:
    return Generator().manual_seed(seed)


@pytest.mark.parametrize("count", [1, 17])
def test_uniform_sampler_takes_equal_steps(count: int, box: Bounds, rays: Rays):
    samples = UniformSampler(box, count)(rays, no_density)
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


@pytest.mark.parametrize("unbounded", [False, True])
def test_uniform_sampler_jitter_stays_in_stratum(unbounded: bool, box: Bounds, rays: Rays):
    bounds, count = replace(box, unbounded=unbounded), 16
    sampler = UniformSampler(bounds, count, stratified=True)
    near, far = bounds.near_far(rays)
    rays, near, far = (x[near < far] for x in (rays, near, far))
    even = torch.linspace(0, 1, count + 1).expand(len(rays), -1)
    strata = bounds.s_to_t(rays, near, far, (even[:, 1:] + even[:, :-1]) / 2)
    jittered = torch.stack([sampler.edges(rays, seeded(i)) for i in range(50)])
    torch.testing.assert_close(jittered[0][:, [0, -1]], sampler.edges(rays, None)[:, [0, -1]])
    inner = jittered[:, :, 1:-1]
    assert (inner >= strata[:, :-1] - 1e-4).all() and (inner <= strata[:, 1:] + 1e-4).all()
    fraction = (inner - strata[:, :-1]) / strata.diff(dim=1)
    assert fraction.amin() < 0.05 and fraction.amax() > 0.95, "jitter covers the stratum"
    assert unbounded or abs(float(fraction.mean()) - 0.5) < 0.05


def test_invert_cdf_inverts_cumulated_weights():
    edges, u = torch.rand(20, 11).cumsum(1), torch.rand(20, 40)
    weights = torch.rand(20, 10) * (torch.rand(20, 10) < 0.3)
    weights[0] = 0  # falls back to uniform over the intervals
    distances = invert_cdf(edges, weights, u)
    for r in range(20):
        cdf = torch.cat([torch.zeros(1), (weights[r].double() + 1e-5).cumsum(0)])
        # Compares probability mass: distances jump where there is no weight.
        mass = np.interp(distances[r], edges[r], cdf / cdf[-1]) - u[r].numpy()
        assert np.abs(mass).max() < 1e-4


def ball(radius: float, density: float):
    return lambda x: density * (x.norm(dim=-1) < radius).float()


@pytest.mark.parametrize(("radius", "unbounded", "train"), [(0.0, False, True), (0.4, False, False), (0.4, True, True)])
def test_importance_sampler_coarse_and_fine_tile_ray(radius, unbounded, train, box: Bounds, rays: Rays):
    bounds = replace(box, unbounded=unbounded)
    chance = Generator().manual_seed(1) if train else None
    samples = ImportanceSampler(bounds, 12, 20)(rays, ball(radius, 5.0), chance)
    start, end = (samples.t - samples.dt / 2), (samples.t + samples.dt / 2)
    near, far = bounds.near_far(rays)
    assert (samples.dt >= 0).all()
    for r in range(len(rays)):
        part = slice(int(samples.offsets[r]), int(samples.offsets[r + 1]))
        if near[r] >= far[r]:
            assert part.start == part.stop
            continue
        assert part.stop - part.start == 12 + 20
        torch.testing.assert_close(start[part][1:], end[part][:-1], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(start[part][0], near[r], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(end[part][-1], far[r], rtol=1e-4, atol=1e-4)
