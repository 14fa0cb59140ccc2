from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import march
from nerf_lightning.sampler import OccupancySampler, Samples, occupancy
from nerf_lightning.sampler.occupancy import INVISIBLE_DEPTH

CUBE = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
OPEN = {"early_stop_eps": 1e-30, "alpha_thre": 0.0}
"""Nothing is dropped for what the field says."""


def fog(positions: Tensor) -> Tensor:
    return torch.ones(len(positions))


def waves(positions: Tensor) -> Tensor:
    """Densities from 0 to 30."""
    return 30 * (4 * positions).sin().prod(1).clamp_min(0)


def seeded(seed: int = 3) -> Generator:
    return Generator().manual_seed(seed)


def same(a: Samples, b: Samples) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("t", "dt", "ray", "offsets"))


def bare(sampler: OccupancySampler, rays: Rays, cells: Tensor, generator: Generator | None = None) -> Samples:
    """All steps in the given cells, whatever the field says."""
    near, far = sampler.bounds.near_far(rays)
    shift = torch.zeros_like(near) if generator is None else torch.rand(near.shape, generator=generator)
    return Samples(
        *march(rays, sampler.bounds, near, far, shift, cells, sampler.samples, sampler.step_size(sampler.samples))
    )


@pytest.mark.parametrize(("unbounded", "training"), [(False, True), (True, False)])
def test_steps_lie_in_occupied_cells(
    unbounded: bool, training: bool, box: Bounds, rays: Rays, kernels: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(occupancy, "INVISIBLE_DEPTH", 0.0)  # else a picture's rays end in fog
    sampler = OccupancySampler(replace(box, unbounded=unbounded), samples=40, resolution=6, **OPEN)
    sampler.grid.occupied = torch.rand(6**3) < 0.4
    actual = sampler(rays, fog, seeded() if training else None)
    assert (
        same(actual, bare(sampler, rays, sampler.grid.occupied, seeded() if training else None)) and len(actual) > 300
    )


def test_steps_behind_wall_or_in_empty_space_are_dropped():
    rays = Rays(torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0, 0]]))
    sampler = OccupancySampler(CUBE, samples=64, resolution=8)
    sampler.grid.optical_depth.fill_(1.0)

    def wall(p: Tensor) -> Tensor:
        return 1e3 * ((p[:, 0] > -0.5) & (p[:, 0] < 0.2)).float()

    for generator in (None, seeded()):
        x = sampler(rays, wall, generator).positions(rays)[:, 0]
        assert 1 <= len(x) <= 2 and (x > -0.5).all() and (x < -0.4).all()


@pytest.mark.parametrize("density", [1e-3, 0.1])
def test_picture_steps_keep_fog(density: float, box: Bounds, rays: Rays, kernels: str):
    sampler = OccupancySampler(box, samples=40, resolution=6)
    everything = bare(sampler, rays, sampler.grid.occupied).dt.sum()
    lost = density * (everything - sampler(rays, lambda x: torch.full((len(x),), density)).dt.sum())
    assert 0 <= lost <= len(rays) * INVISIBLE_DEPTH * (1 + 1e-5)
    assert lost > 0 or density * sampler.step_size(sampler.samples) > INVISIBLE_DEPTH


def test_picture_steps_in_parts_are_the_same(box: Bounds, rays: Rays):
    sampler = OccupancySampler(box, samples=40, resolution=6)
    whole, parts = sampler(rays, waves), [sampler(rays[i : i + 7], waves) for i in range(0, len(rays), 7)]
    assert torch.equal(whole.t, torch.cat([part.t for part in parts]))


@pytest.mark.parametrize("density", [0.0, 1e-3])
def test_training_steps_keep_thin_fog(density: float, box: Bounds, rays: Rays):
    sampler = OccupancySampler(box, samples=40, resolution=6, alpha_thre=0.1)
    everything = bare(sampler, rays, sampler.grid.occupied, seeded())
    sampler.grid.optical_depth.fill_(density * sampler.step_size(sampler.samples))
    samples = sampler(rays, lambda x: torch.full((len(x),), density), seeded())
    short = everything.dt < 0.5 * sampler.step_size(sampler.samples) * (density > 0)  # cut off where a ray ends
    assert torch.equal(samples.t, everything.t[~short]) and short.float().mean() < 0.1
