from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Generator

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import inverse_cdf
from nerf_lightning.sampler import ImportanceSampler


@pytest.mark.parametrize("kind", ["random", "one", "none", "sparse"])
def test_inverse_cdf_any_weights_inverts_cumulated_weights(kind: str):
    edges = torch.rand(20, 11).cumsum(1)
    weights = {
        "random": torch.rand(20, 10),
        "one": torch.eye(10).repeat(2, 1),
        "none": torch.zeros(20, 10),
        "sparse": torch.rand(20, 10) * (torch.rand(20, 10) < 0.3),
    }[kind]
    u = torch.rand(20, 40)
    u[:, :2] = torch.tensor([0.0, 1.0])
    actual = inverse_cdf(edges, weights, u).numpy()
    for r in range(20):
        # The floor lets an empty ray fall back to uniform in the interval's number.
        cdf = np.concatenate([[0], np.cumsum(weights[r].double().numpy() + 1e-5)])
        expected = np.interp(u[r].double().numpy(), cdf / cdf[-1], edges[r].double().numpy())
        # What counts is the probability mass between the two answers: distances jump where there is no weight.
        mass = np.interp(actual[r], edges[r].double().numpy(), cdf / cdf[-1]) - u[r].double().numpy()
        assert np.abs(mass).max() < 1e-4
        if kind in ("random", "none"):
            np.testing.assert_allclose(actual[r], expected, atol=2e-3)
        assert actual[r].min() >= edges[r, 0] and actual[r].max() <= edges[r, -1]


def ball(radius: float, density: float):
    return lambda x: density * (x.norm(dim=-1) < radius).float()


def along_x(count: int) -> Rays:
    origins = torch.tensor([-3.0, 0.0, 0.0]).repeat(count, 1)
    return Rays(origins, torch.tensor([1.0, 0.0, 0.0]).repeat(count, 1))


@pytest.mark.parametrize("generator", [None, 5])
def test_importance_sampler_samples_crowd_where_density_is(generator: int | None):
    box = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    chance = None if generator is None else Generator().manual_seed(generator)
    samples = ImportanceSampler(box, 32, 64)(along_x(4), ball(0.15, 3.0), chance)
    x = samples.t - 3
    assert ((x.abs() < 0.25).float().mean() > 0.65) and ((x.abs() < 0.25).sum() > 4 * 64)


DENSITIES = {
    "nothing": lambda x: torch.zeros(len(x)),
    "ball": ball(0.4, 5.0),
    "wall": lambda x: 1e6 * (x[:, 0] > 0).float(),
    "everywhere": lambda x: torch.ones(len(x)),
}


@pytest.mark.parametrize(
    ("density", "unbounded", "training"),
    [
        ("nothing", False, True),
        ("ball", False, False),
        ("ball", True, True),
        ("wall", True, False),
        ("everywhere", False, True),
    ],
)
def test_importance_sampler_coarse_and_fine_tile_ray(density, unbounded, training, box: Bounds, rays: Rays):
    bounds = replace(box, unbounded=unbounded)
    chance = Generator().manual_seed(1) if training else None
    samples = ImportanceSampler(bounds, 12, 20)(rays, DENSITIES[density], chance)
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
