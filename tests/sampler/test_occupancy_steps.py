import math
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import march
from nerf_lightning.sampler import OccupancySampler, Samples, occupancy
from nerf_lightning.sampler.occupancy import ASKED, UNSEEN

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
        *march(rays, sampler.bounds, near, far, shift, cells, sampler.samples, sampler.length(sampler.samples))
    )


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("training", [False, True])
def test_steps_are_taken_in_occupied_cells(
    training: bool, unbounded: bool, box: Bounds, rays: Rays, kernels: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(occupancy, "UNSEEN", 0.0)  # else a picture's rays end in fog
    sampler = OccupancySampler(replace(box, unbounded=unbounded), samples=40, resolution=6, **OPEN)
    sampler.occupied = torch.rand(6**3) < 0.4
    actual = sampler(rays, fog, seeded() if training else None)
    assert same(actual, bare(sampler, rays, sampler.occupied, seeded() if training else None)) and len(actual) > 300


def test_steps_follow_the_generator(box: Bounds, rays: Rays):
    sampler = OccupancySampler(box, samples=40, resolution=6, **OPEN)
    assert same(sampler(rays, fog, seeded()), sampler(rays, fog, seeded()))
    assert same(sampler(rays, fog), sampler(rays, fog))
    assert not same(sampler(rays, fog, seeded()), sampler(rays, fog, seeded(4)))
    assert not same(sampler(rays, fog, seeded()), sampler(rays, fog))


@pytest.mark.parametrize("early_stop_eps", [1e-4, 0.3])
@pytest.mark.parametrize("alpha_thre", [0.0, 5e-3, 0.1])
def test_what_is_kept_agrees_with_a_loop(
    early_stop_eps: float, alpha_thre: float, box: Bounds, rays: Rays, kernels: str
):
    sampler = OccupancySampler(box, samples=40, resolution=6, early_stop_eps=early_stop_eps, alpha_thre=alpha_thre)
    sampler.occupied = torch.rand(6**3) < 0.6
    sampler.thickness.fill_(1.0)
    steps, actual = bare(sampler, rays, sampler.occupied, seeded()), sampler(rays, waves, seeded())
    thickness = (waves(steps.positions(rays)) * steps.dt).tolist()
    kept, ends = [], [0]
    for first, last in zip(steps.offsets[:-1].tolist(), steps.offsets[1:].tolist(), strict=True):
        before = 0.0
        for i in range(first, last):
            if math.exp(-before) >= early_stop_eps and 1 - math.exp(-thickness[i]) >= alpha_thre:
                kept.append(i)
            before += thickness[i]
        ends.append(len(kept))
    assert same(actual, Samples(steps.t[kept], steps.dt[kept], steps.ray[kept], torch.tensor(ends)))
    assert len(kept) < len(steps) and len(kept) > 50


def test_nothing_is_kept_behind_a_wall_or_in_empty_space():
    rays = Rays(torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0, 0]]))
    sampler = OccupancySampler(CUBE, samples=64, resolution=8)
    sampler.thickness.fill_(1.0)

    def wall(p: Tensor) -> Tensor:
        return 1e3 * ((p[:, 0] > -0.5) & (p[:, 0] < 0.2)).float()

    for generator in (None, seeded()):
        x = sampler(rays, wall, generator).positions(rays)[:, 0]
        assert 1 <= len(x) <= 2 and (x > -0.5).all() and (x < -0.4).all()


@pytest.mark.parametrize("density", [1e-5, 1e-3, 1e-2, 0.1])
def test_pictures_keep_fog_but_for_less_than_anyone_sees(density: float, box: Bounds, rays: Rays, kernels: str):
    sampler = OccupancySampler(box, samples=40, resolution=6)
    everything = bare(sampler, rays, sampler.occupied).dt.sum()
    lost = density * (everything - sampler(rays, lambda x: torch.full((len(x),), density)).dt.sum())
    assert 0 <= lost <= len(rays) * UNSEEN * (1 + 1e-5)
    assert lost > 0 or density * sampler.length(sampler.samples) > UNSEEN


def test_a_picture_does_not_depend_on_how_its_rays_are_cut(box: Bounds, rays: Rays):
    sampler = OccupancySampler(box, samples=40, resolution=6)
    whole, parts = sampler(rays, waves), [sampler(rays[i : i + 7], waves) for i in range(0, len(rays), 7)]
    assert torch.equal(whole.t, torch.cat([part.t for part in parts]))


def test_rays_of_pictures_end_where_the_rest_is_less_than_anyone_sees(box: Bounds, rays: Rays, kernels: str):
    samples = OccupancySampler(box, samples=40, resolution=6)(rays, lambda x: torch.full((len(x),), 20.0))
    passed = torch.zeros(len(rays)).index_add(0, samples.ray, 20.0 * samples.dt)
    deep = passed > 1.1 * -math.log(UNSEEN)
    last = samples.dt[samples.offsets[1:].sub(1).clamp_min(0)]
    assert deep.any() and (passed - 20.0 * last <= -math.log(UNSEEN) + 1e-4).all()


@pytest.mark.parametrize("density", [0.0, 1e-6, 1e-3])
def test_a_thin_fog_is_kept(density: float, box: Bounds, rays: Rays):
    sampler = OccupancySampler(box, samples=40, resolution=6, alpha_thre=0.1)
    everything = bare(sampler, rays, sampler.occupied, seeded())
    sampler.thickness.fill_(density * sampler.length(sampler.samples))
    samples = sampler(rays, lambda x: torch.full((len(x),), density), seeded())
    short = everything.dt < 0.5 * sampler.length(sampler.samples) * (density > 0)  # cut off where a ray ends
    assert torch.equal(samples.t, everything.t[~short]) and short.float().mean() < 0.1


def test_what_is_not_a_number_is_kept(box: Bounds, rays: Rays, kernels: str):
    sampler = OccupancySampler(box, samples=40, resolution=6)
    samples = sampler(rays, lambda x: torch.where(x[:, 2] > 0.5, float("nan"), 0.0))
    assert (samples.positions(rays)[:, 2] > 0.5).any()


@pytest.mark.parametrize("chunk", [1, 25, 250])
def test_asking_fewer_positions_together_changes_nothing(chunk: int, box: Bounds, rays: Rays):
    sampler, asked = OccupancySampler(box, samples=40, resolution=6), []

    def counted(x: Tensor) -> Tensor:
        asked.append(len(x))
        return waves(x)

    whole, together = sampler(rays, counted, seeded()), list(asked)
    asked.clear()
    sampler.chunk = chunk
    assert sampler.rays_at_once >= 1
    parts = sampler(rays, counted, seeded())
    assert same(whole, parts) and sum(asked) == sum(together) > 500
    assert max(asked) == min(ASKED * chunk, max(together))


def test_the_field_is_asked_without_gradient(box: Bounds, rays: Rays):
    level = torch.tensor(20.0, requires_grad=True)
    samples = OccupancySampler(box, samples=40, resolution=6)(rays, lambda x: level.expand(len(x)), seeded())
    assert len(samples) and not samples.t.requires_grad


def test_no_rays_or_only_misses_give_no_samples(box: Bounds, rays: Rays, kernels: str):
    sampler = OccupancySampler(box, samples=8, resolution=4)
    assert sampler(rays[:0], waves, seeded()).offsets.tolist() == [0]
    missing = sampler(rays[-1:], waves)
    assert len(missing) == 0 and missing.offsets.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("early_stop_eps", 0.0),
        ("early_stop_eps", 1.0),
        ("early_stop_eps", -1e-4),
        ("alpha_thre", -0.1),
        ("alpha_thre", 1.0),
    ],
)
def test_other_transmittances_and_opacities_are_refused(key: str, value: float):
    with pytest.raises(InputError, match=f"sampler.{key}"):
        OccupancySampler(CUBE, **{key: value})
