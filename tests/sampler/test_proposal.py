from dataclasses import replace

import pytest
import torch
from torch import Generator

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import interlevel_loss, volume_weights
from nerf_lightning.sampler import OccupancySampler, ProposalSampler, Samples, choose_sampler

UNBOUNDED = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), unbounded=True, near=0.1)


def zero_density(positions: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(positions))


def rays(count: int, seed: int = 0) -> Rays:
    """Rays from a ring around the origin toward points near it."""
    generator = Generator().manual_seed(seed)
    turn = 6.28 * torch.rand(count, generator=generator)
    origins = torch.stack([2 * turn.cos(), 2 * turn.sin(), 0.5 * torch.ones(count)], dim=1)
    targets = 0.2 * torch.randn(count, 3, generator=generator)
    return Rays(origins, torch.nn.functional.normalize(targets - origins, dim=1))


def ball(positions: torch.Tensor) -> torch.Tensor:
    """Density of a ball around the origin and a distant shell."""
    radius = positions.norm(dim=1)
    return 30.0 * ((radius < 0.3) | (radius > 4)).float()


def train_sampler(sampler: ProposalSampler, steps: int) -> ProposalSampler:
    """Trains the proposals against a fixed field."""
    optimizer = torch.optim.Adam(sampler.parameters(), lr=0.05)
    for step in range(steps):
        generator = Generator().manual_seed(step)
        batch = rays(256, step)
        sampler.update(step, ball, generator)
        samples = sampler(batch, ball, generator)
        weights = volume_weights(ball(samples.positions(batch)), samples.dt, samples.ray, samples.offsets)
        loss = sampler.losses(samples, weights)["interlevel"]
        assert loss is not None
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return sampler


def fraction_on_surfaces(samples: Samples, batch: Rays) -> float:
    """Fraction of the samples near the surface of the ball or the shell."""
    radius = samples.positions(batch).norm(dim=1)
    return float((((radius - 0.3).abs() < 0.1) | ((radius - 4).abs() < 0.4)).float().mean())


def test_proposal_sampler_after_training_finds_surfaces():
    small = ProposalSampler(UNBOUNDED, anneal=20)
    batch = rays(200, 99)
    before = fraction_on_surfaces(small(batch, ball), batch)
    after = fraction_on_surfaces(train_sampler(small, 60)(batch, ball), batch)
    assert before < 0.25 and after > 0.5


def test_proposal_sampler_samples_tile_ray():
    sampler, batch = ProposalSampler(UNBOUNDED, samples=10), rays(30)
    samples = sampler(batch, zero_density, Generator().manual_seed(1))
    t, dt = samples.t.view(30, 10), samples.dt.view(30, 10)
    assert samples.offsets.tolist() == list(range(0, 301, 10))
    assert torch.equal(samples.ray, torch.arange(30).repeat_interleave(10))
    assert (dt >= 0).all()
    torch.testing.assert_close(t[:, 1:] - dt[:, 1:] / 2, t[:, :-1] + dt[:, :-1] / 2, rtol=1e-4, atol=1e-4)


def test_interlevel_loss_only_unexpected_weight_costs():
    edges = torch.linspace(0, 1, 5)[None]
    main_weights = torch.tensor([[0.0, 0.2, 0.5, 0.0]])

    def cost(*proposed: float) -> torch.Tensor:
        weights = torch.tensor([proposed], requires_grad=True)
        loss = interlevel_loss(weights, torch.linspace(0, 1, len(proposed) + 1)[None], edges, main_weights)
        loss.backward()
        return torch.cat([loss.detach()[None], weights.grad[0]])

    assert not cost(0.3, 0.6).any(), "more than enough in either half"
    assert not cost(0.0, 0.2, 0.5, 0.0).any()
    too_little = cost(0.3, 0.4)
    assert too_little[0] == pytest.approx(0.1**2 / 0.5, rel=1e-3)
    assert too_little[1] == 0 and too_little[2] < 0


def test_proposal_sampler_state_export_renders_alike():
    sampler, other, batch = train_sampler(ProposalSampler(UNBOUNDED), 20), ProposalSampler(UNBOUNDED), rays(20)
    other.import_state(sampler.export_state())
    assert torch.equal(sampler(batch, ball).t, other(batch, ball).t)
    with pytest.raises(RuntimeError, match="size mismatch"):
        ProposalSampler(UNBOUNDED, max_resolution=48).import_state(sampler.export_state())


def test_choose_sampler_unbounded_scene_takes_proposals():
    assert isinstance(choose_sampler(UNBOUNDED), ProposalSampler)
    assert isinstance(choose_sampler(replace(UNBOUNDED, unbounded=False, near=None)), OccupancySampler)
