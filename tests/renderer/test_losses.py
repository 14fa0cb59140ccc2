"""Regularization losses, and the median depth, exact for piecewise constant density."""

import math

import pytest
import torch

from nerf_lightning.kernels import median_depth, volume_weights
from nerf_lightning.kernels.weight_losses import distortion_loss, near_loss, view_loss
from nerf_lightning.sampler import Samples
from tests.helpers.ragged_samples import SAMPLE_COUNTS, make_ragged_samples


def packed(counts: list[int]) -> tuple[torch.Tensor, Samples]:
    """Densities and samples of rays with these counts, in float64."""
    samples = make_ragged_samples(counts, torch.float64)
    return torch.rand(len(samples), dtype=torch.float64), samples


def weights(density: torch.Tensor, samples: Samples) -> torch.Tensor:
    return volume_weights(density, samples.dt, samples.ray, samples.offsets)


def distortion_over_pairs(density: torch.Tensor, samples: Samples, scale: float) -> torch.Tensor:
    """The paper's formula, ray by ray and pair by pair."""
    total = torch.zeros((), dtype=torch.float64)
    for first, last in zip(samples.offsets[:-1].tolist(), samples.offsets[1:].tolist(), strict=True):
        t, dt, optical_depth = (x[first:last] for x in (samples.t, samples.dt, density * samples.dt))
        through = torch.exp(-torch.cat([optical_depth.new_zeros(1), optical_depth.cumsum(0)]))[: last - first]
        w, s, width = through * (1 - torch.exp(-optical_depth)), t / (t + scale), dt * scale / (t + scale) ** 2
        total = total + (w[:, None] * w * (s[:, None] - s).abs()).sum() + (w**2 * width).sum() / 3
    return total / (len(samples.offsets) - 1)


@pytest.mark.parametrize("counts", [[5, 1, 7], [0, 4, 0, 3, 0], [6]])
def test_distortion_loss_matches_sum_over_pairs(counts: list[int]):
    density, samples = packed(counts)
    density.requires_grad_()
    fast, slow = (
        distortion_loss(weights(density, samples), samples.packed, 0.7),
        distortion_over_pairs(density, samples, 0.7),
    )
    torch.testing.assert_close(fast, slow)
    torch.testing.assert_close(torch.autograd.grad(fast, density), torch.autograd.grad(slow, density))


def test_near_loss_falls_with_distance():
    density, samples = packed([6, 6])
    nearness = 0.5 / (samples.t + 0.5)
    w = weights(density, samples)
    torch.testing.assert_close(near_loss(w, samples.packed, 0.5), (w * nearness**4).view(2, 6).sum(1).mean())
    walls = torch.eye(6, dtype=torch.float64)
    costs = [near_loss(torch.cat([wall, wall]), samples.packed, 0.5) for wall in walls]
    assert costs == sorted(costs, reverse=True)


def test_view_loss_has_no_gradient_of_weights():
    density, samples = packed([6, 0, 3])
    view_part = torch.rand(9, 3, dtype=torch.float64, requires_grad=True)
    w = weights(density.requires_grad_(), samples)
    loss = view_loss(w, view_part, samples.packed)
    rays = [(w[a:b, None] * view_part[a:b] ** 2).sum() for a, b in ((0, 6), (6, 6), (6, 9))]
    torch.testing.assert_close(loss, torch.stack(rays).mean())
    loss.backward()
    assert density.grad is None and view_part.grad is not None
    assert view_loss(w, torch.zeros(9, 3), samples.packed) == 0


def test_view_loss_textureless_pixels_cost_more():
    density, samples = packed([6, 0, 3])
    w, texturelessness = weights(density, samples), torch.tensor([1.0, 0.3, 0.5], dtype=torch.float64)
    view_part = 0.1 + torch.rand(9, 3, dtype=torch.float64)
    sizes = w * view_part.norm(dim=1)
    extra = 10.0 * (1.0 * sizes[:6].sum() + 0.5 * sizes[6:].sum()) / 3
    torch.testing.assert_close(
        view_loss(w, view_part, samples.packed, texturelessness) - view_loss(w, view_part, samples.packed),
        extra,
        rtol=0.01,
        atol=0.0,
    )
    zeros = torch.zeros(9, 3, dtype=torch.float64, requires_grad=True)
    loss = view_loss(w, zeros, samples.packed, texturelessness)
    loss.backward()
    assert loss == 0 and zeros.grad is not None and not zeros.grad.any()


@pytest.mark.parametrize("counts", SAMPLE_COUNTS[1:3])
def test_median_depth_halves_opacity(counts: list[int]):
    samples = make_ragged_samples(counts, torch.float64)
    density = 4 * torch.rand(len(samples), dtype=torch.float64)

    def opacity_before(ray: int, distance: float) -> float:
        """Opacity of a ray up to a distance, interval by interval."""
        part = slice(samples.offsets[ray], samples.offsets[ray + 1])
        start = samples.t[part] - samples.dt[part] / 2
        return 1 - math.exp(-float((density[part] * (distance - start).clamp_min(0).minimum(samples.dt[part])).sum()))

    opacity = torch.tensor([opacity_before(ray, math.inf) for ray in range(len(counts))], dtype=torch.float64)
    depth = median_depth(density, opacity, samples.packed)
    for ray, count in enumerate(counts):
        if count:
            assert opacity_before(ray, float(depth[ray])) == pytest.approx(float(opacity[ray]) / 2, rel=1e-6)
        else:
            assert depth[ray] == 0


def test_median_depth_ignores_long_last_interval():
    samples = make_ragged_samples([3])
    samples.dt[2], samples.t[2] = 1000, 500
    density = torch.tensor([0.0, 1e3, 1e-5])
    depth = median_depth(density, torch.tensor([0.99]), samples.packed)
    assert abs(float(depth) - float(samples.t[1])) < float(samples.dt[1])
