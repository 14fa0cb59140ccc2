import math

import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import composite, use_kernels, volume_weights
from nerf_lightning.sampler import Samples
from tests.helpers.ragged_samples import COUNTS, ragged_samples


@pytest.fixture(params=["formula", "auto", "reference"])
def weights_of(request: pytest.FixtureRequest):
    """How much each sample weighs: by the formula, and as the gradient of a ray's colour with respect to the sample's."""
    if request.param == "formula":
        return lambda density, samples: volume_weights(density, samples.dt, samples.ray, samples.offsets)
    use_kernels(request.param)

    def weights(density: Tensor, samples: Samples) -> Tensor:
        rgb = torch.zeros(len(samples), 3, requires_grad=True)
        colour, _, _ = composite(density, rgb, samples.t, samples.dt, samples.ray, samples.offsets)
        gradients = [torch.autograd.grad(c.sum(), rgb, retain_graph=True)[0][:, i] for i, c in enumerate(colour.T)]
        assert torch.equal(gradients[0], gradients[1]) and torch.equal(gradients[0], gradients[2])
        return gradients[0]

    return weights


@pytest.mark.parametrize(("counts", "scale"), list(zip(COUNTS, 2 * [0.1, 3.0, 100.0], strict=True)))
def test_weights_any_density_match_loop_over_samples(counts, scale, weights_of):
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
    opacity = torch.zeros(len(counts)).index_add(0, samples.ray, actual)
    assert (actual >= 0).all() and (opacity <= 1 + 1e-6).all()
    assert (opacity[torch.tensor(counts) == 0] == 0).all()


@pytest.mark.parametrize(("splits", "sigma"), [(1, 0.7), (7, 0.0), (7, 20.0), (100, 0.01)])
def test_weights_constant_density_split_keep_opacity(splits, sigma, weights_of):
    samples = ragged_samples([splits, 3, splits])
    weights = weights_of(torch.full((len(samples),), sigma), samples)
    for ray in range(3):
        part = slice(int(samples.offsets[ray]), int(samples.offsets[ray + 1]))
        expected = -math.expm1(-sigma * float(samples.dt[part].double().sum()))
        assert float(weights[part].double().sum()) == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_weights_thin_fog_keep_digits(weights_of):
    samples = ragged_samples([3])
    torch.testing.assert_close(weights_of(torch.full((3,), 1e-9), samples), 1e-9 * samples.dt, rtol=1e-5, atol=0)


def test_weights_after_thick_rays_stay_exact(weights_of):
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


def test_volume_weights_gradients_match_differences():
    samples = ragged_samples([3, 0, 5], torch.float64)
    density = (2 * torch.rand(len(samples), dtype=torch.float64)).requires_grad_()
    dt = samples.dt.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d: volume_weights(s, d, samples.ray, samples.offsets), (density, dt))


def test_gradients_behind_opaque_sample_are_finite(kernels: str):
    samples = ragged_samples([4])
    density = torch.tensor([1e6, 1.0, 1e6, 0.0], requires_grad=True)
    volume_weights(density, samples.dt, samples.ray, samples.offsets).square().sum().backward()
    assert density.grad.isfinite().all()
    seen = composite(density, torch.rand(4, 3), samples.t, samples.dt, samples.ray, samples.offsets)
    (gradient,) = torch.autograd.grad(sum(x.square().sum() for x in seen), density)
    assert gradient.isfinite().all() and gradient[0].abs() < 1e-6, "no more of it can be seen"


@pytest.mark.parametrize("where", [0, 4])
def test_composite_nan_density_shows_in_its_ray(where: int, kernels: str):
    samples = ragged_samples([3, 5, 2])
    density = 0.1 + torch.rand(10)
    density[3 + where] = math.nan
    seen = composite(density, torch.rand(10, 3), samples.t, samples.dt, samples.ray, samples.offsets)
    for values in seen:
        assert values[1].isnan().all() and values[0].isfinite().all()
