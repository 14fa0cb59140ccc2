import math

import jaxtyping
import pytest
import torch
from torch import Tensor

from nerf_lightning.renderer import accumulate, volume_weights
from nerf_lightning.sampler import Samples

COUNTS = [[4], [3, 0, 5, 1], [0, 0, 7, 0], [0], [1] * 6, [30, 0, 2, 11, 0]]


def weights_of(density: Tensor, samples: Samples) -> Tensor:
    return volume_weights(density, samples.dt, samples.ray, samples.offsets)


@pytest.mark.parametrize("counts", COUNTS)
@pytest.mark.parametrize("scale", [0.1, 3.0, 100.0])
def test_weights_agree_with_a_loop_along_each_ray(counts, scale, ragged_samples):
    samples = ragged_samples(counts)
    density = scale * torch.rand(len(samples)) * (torch.rand(len(samples)) < 0.7)
    expected, i = [], 0
    for count in counts:
        transmittance = 1.0
        for _ in range(count):
            alpha = 1 - math.exp(-float(density[i]) * float(samples.dt[i]))
            expected.append(transmittance * alpha)
            transmittance *= 1 - alpha
            i += 1
    actual = weights_of(density, samples)
    torch.testing.assert_close(actual, torch.tensor(expected), rtol=1e-4, atol=1e-6)
    opacity = accumulate(actual, torch.ones(len(samples), 1), samples.ray, len(counts))[:, 0]
    assert (actual >= 0).all() and (opacity <= 1 + 1e-6).all()
    assert (opacity[torch.tensor(counts) == 0] == 0).all()


@pytest.mark.parametrize("wall", [0, 2, 4])
def test_one_huge_density_takes_all_the_weight(wall, ragged_samples):
    samples = ragged_samples([3, 5, 2])
    density = torch.zeros(10)
    density[3 + wall] = 1e9
    assert torch.equal(weights_of(density, samples), torch.eye(10)[3 + wall])


def test_behind_a_wall_nothing_counts(ragged_samples):
    density = torch.tensor([0.0, 1e9, 1e9, 5.0])
    assert weights_of(density, ragged_samples([4])).tolist() == [0, 1, 0, 0]


@pytest.mark.parametrize("splits", [1, 2, 7, 100])
@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.7, 20.0])
def test_constant_density_is_as_opaque_however_it_is_split(splits, sigma, ragged_samples):
    samples = ragged_samples([splits, 3, splits])
    weights = weights_of(torch.full((len(samples),), sigma), samples)
    for ray in range(3):
        part = slice(int(samples.offsets[ray]), int(samples.offsets[ray + 1]))
        expected = -math.expm1(-sigma * float(samples.dt[part].double().sum()))
        assert float(weights[part].double().sum()) == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_thin_fog_keeps_its_digits(ragged_samples):
    samples = ragged_samples([3])
    torch.testing.assert_close(weights_of(torch.full((3,), 1e-9), samples), 1e-9 * samples.dt, rtol=1e-5, atol=0)


def test_thick_rays_leave_the_later_ones_exact(ragged_samples):
    thick, thin = ragged_samples([100] * 300), ragged_samples([6])
    both = Samples(
        torch.cat([thick.t, thin.t]),
        torch.cat([thick.dt, thin.dt]),
        torch.cat([thick.ray, thin.ray + 300]),
        torch.cat([thick.offsets, thin.offsets[1:] + len(thick)]),
    )
    density = torch.cat([torch.full((len(thick),), 1e6), torch.rand(6)])
    weights = weights_of(density, both)
    assert weights.isfinite().all()
    torch.testing.assert_close(weights[-6:], weights_of(density[-6:], thin), rtol=1e-5, atol=0)


@pytest.mark.parametrize("counts", [[4], [3, 0, 5], [0, 2]])
def test_gradients(counts, ragged_samples):
    samples = ragged_samples(counts, torch.float64)
    density = (2 * torch.rand(len(samples), dtype=torch.float64)).requires_grad_()
    dt = samples.dt.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d: volume_weights(s, d, samples.ray, samples.offsets), (density, dt))
    values = torch.rand(len(samples), 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w, v: accumulate(w, v, samples.ray, len(counts)), (density, values))


def test_gradients_behind_something_opaque_are_finite(ragged_samples):
    density = torch.tensor([1e6, 1.0, 1e6, 0.0], requires_grad=True)
    weights_of(density, ragged_samples([4])).square().sum().backward()
    assert density.grad.isfinite().all()


@pytest.mark.parametrize("counts", COUNTS)
def test_accumulate_sums_over_each_ray(counts, ragged_samples):
    samples = ragged_samples(counts)
    weights, values = torch.rand(len(samples)), torch.rand(len(samples), 3)
    expected = [(w[:, None] * v).sum(0) for w, v in zip(weights.split(counts), values.split(counts), strict=True)]
    torch.testing.assert_close(accumulate(weights, values, samples.ray, len(counts)), torch.stack(expected))


def test_a_wrong_shape_is_refused_in_tests():
    n, ray, offsets = torch.zeros(3), torch.zeros(3).long(), torch.tensor([0, 3])
    for call in (
        lambda: volume_weights(n, torch.zeros(2), ray, offsets),
        lambda: volume_weights(n, n, n, offsets),
        lambda: accumulate(n, n, ray, 1),
    ):
        with pytest.raises(jaxtyping.TypeCheckError):
            call()
