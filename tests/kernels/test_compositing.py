"""Rendering weights, compositing, and dropping and merging of samples."""

import math

import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import composite, filter_visible, merge_low_weight, set_kernels, volume_weights
from nerf_lightning.sampler import Samples
from tests.helpers.ragged_samples import BUNDLE, SAMPLE_COUNTS, make_ragged_samples


@pytest.fixture(params=["formula", "auto", "reference"])
def weights_of(request: pytest.FixtureRequest):
    """Rendering weights: by the formula, and as the gradient of a ray's color in the sample's color."""
    if request.param == "formula":
        return lambda density, samples: volume_weights(density, samples.dt, samples.ray, samples.offsets)
    set_kernels(request.param)

    def weights(density: Tensor, samples: Samples) -> Tensor:
        rgb = torch.zeros(len(samples), 3, requires_grad=True)
        color, _, _ = composite(density, rgb, samples.t, samples.dt, samples.ray, samples.offsets)
        gradients = [torch.autograd.grad(c.sum(), rgb, retain_graph=True)[0][:, i] for i, c in enumerate(color.T)]
        assert torch.equal(gradients[0], gradients[1]) and torch.equal(gradients[0], gradients[2])
        return gradients[0]

    return weights


@pytest.mark.parametrize(("counts", "scale"), list(zip(SAMPLE_COUNTS, 2 * [0.1, 3.0, 100.0], strict=True)))
def test_volume_weights_any_density_match_loop_over_samples(counts, scale, weights_of):
    samples = make_ragged_samples(counts)
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


def test_volume_weights_small_density_is_precise(weights_of):
    samples = make_ragged_samples([3])
    torch.testing.assert_close(weights_of(torch.full((3,), 1e-9), samples), 1e-9 * samples.dt, rtol=1e-5, atol=0)


def test_volume_weights_many_opaque_rays_stay_exact(weights_of):
    thick, thin = make_ragged_samples([100] * 300), make_ragged_samples([6])
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
    samples = make_ragged_samples([3, 0, 5], torch.float64)
    density = (2 * torch.rand(len(samples), dtype=torch.float64)).requires_grad_()
    dt = samples.dt.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda s, d: volume_weights(s, d, samples.ray, samples.offsets), (density, dt))


def test_composite_sample_after_opaque_one_has_finite_gradient(kernels: str):
    samples = make_ragged_samples([4])
    density = torch.tensor([1e6, 1.0, 1e6, 0.0], requires_grad=True)
    volume_weights(density, samples.dt, samples.ray, samples.offsets).square().sum().backward()
    assert density.grad.isfinite().all()
    seen = composite(density, torch.rand(4, 3), samples.t, samples.dt, samples.ray, samples.offsets)
    (gradient,) = torch.autograd.grad(sum(x.square().sum() for x in seen), density)
    assert gradient.isfinite().all() and gradient[0].abs() < 1e-6, "no more of it can be seen"


MIN_SAMPLE_WEIGHT = 0.1


@pytest.mark.parametrize("where", [0, 4])
def test_composite_nan_density_propagates_to_its_ray(where: int, kernels: str):
    samples = make_ragged_samples([3, 5, 2])
    density = 0.1 + torch.rand(10)
    density[3 + where] = math.nan
    seen = composite(density, torch.rand(10, 3), samples.t, samples.dt, samples.ray, samples.offsets)
    for values in seen:
        assert values[1].isnan().all() and values[0].isfinite().all()


def packed(samples: Samples):
    return samples.t, samples.dt, samples.ray, samples.offsets


def foggy(counts: list[int]) -> tuple[torch.Tensor, Samples]:
    """Optical depths and samples with gaps between some."""
    samples = make_ragged_samples(counts)
    keep = torch.rand(len(samples)) < 0.8
    ends = torch.cat([torch.zeros(1, dtype=torch.int64), keep.cumsum(0)])[samples.offsets]
    some = Samples(samples.t[keep], samples.dt[keep], samples.ray[keep], ends)
    return 2 * torch.rand(len(some)) ** 3, some


def merge_brute_force(optical_depth: torch.Tensor, samples: Samples, min_weight: float) -> list[tuple[float, ...]]:
    """Optical depth, t, dt and ray of the remaining samples."""
    found: list[tuple[float, ...]] = []
    for ray in range(len(samples.offsets) - 1):
        passed, last, weight_before = 0.0, None, 0.0
        for n in range(int(samples.offsets[ray]), int(samples.offsets[ray + 1])):
            own, t, dt = (float(x[n]) for x in (optical_depth, samples.t, samples.dt))
            weight = math.exp(-passed) * (1 - math.exp(-own))
            passed += own
            touches = last is not None and (t - dt / 2) - (last[1] + last[2] / 2) < 0.02
            if touches and min(weight, weight_before) < min_weight:
                both = weight + weight_before
                found[-1] = (own + last[0], (weight * t + weight_before * last[1]) / both, dt + last[2], ray)
                last = None  # at most two
            else:
                found.append((own, t, dt, ray))
                last = own, t, dt
            weight_before = weight
    return found


@pytest.mark.parametrize(
    ("counts", "min_weight"),
    [([0], MIN_SAMPLE_WEIGHT), ([30, 0, 2, 11, 0], 0.0), (BUNDLE, MIN_SAMPLE_WEIGHT), (BUNDLE, 1.1)],
)
def test_merge_low_weight_matches_loop_over_samples(counts: list[int], min_weight: float, kernels: str):
    optical_depth, samples = foggy(counts)
    merged, (t, dt, ray, offsets) = merge_low_weight(optical_depth, packed(samples), min_weight)
    wanted = merge_brute_force(optical_depth, samples, min_weight)
    torch.testing.assert_close(torch.stack([merged, t, dt, ray.float()], dim=1), torch.tensor(wanted).view(-1, 4))
    assert torch.equal(offsets.diff(), torch.bincount(ray, minlength=len(counts)))
    assert len(t) < len(samples) or min_weight == 0 or len(samples) < 20


@pytest.mark.parametrize(
    ("counts", "early_stop_eps", "min_optical_depth", "max_dropped"),
    [
        ([0], 1e-4, 0.2, math.inf),
        ([30, 0, 2, 11, 0], 1e-4, 0.2, math.inf),
        ([30, 0, 2, 11, 0], 0.5, 0.0, math.inf),
        ([30, 0, 2, 11, 0], 1e-4, 0.2, 0.3),
    ],
)
def test_filter_visible_any_threshold_matches_loop_over_samples(
    counts: list[int], early_stop_eps: float, min_optical_depth: float, max_dropped: float, kernels: str
):
    samples = make_ragged_samples(counts)
    density = 20 * torch.rand(len(samples)) * (torch.rand(len(samples)) < 0.7)
    kept, ends, i = [], [0], 0
    for count in counts:
        transmittance, thin = 1.0, 0.0
        for _ in range(count):
            optical_depth = float(density[i]) * float(samples.dt[i])
            thin += optical_depth if optical_depth < min_optical_depth else 0.0
            if transmittance >= early_stop_eps and (optical_depth >= min_optical_depth or thin > max_dropped):
                kept.append(i)
            transmittance *= math.exp(-optical_depth)
            i += 1
        ends.append(len(kept))
    given = density * samples.dt, packed(samples), early_stop_eps, min_optical_depth
    optical_depth, (t, dt, ray, offsets), _ = filter_visible(*given, max_dropped=max_dropped)
    assert torch.equal(optical_depth, given[0][kept])
    assert torch.equal(t, samples.t[kept]) and torch.equal(dt, samples.dt[kept])
    assert torch.equal(ray, samples.ray[kept]) and offsets.tolist() == ends


def test_filter_visible_nan_density_stays(kernels: str):
    samples = make_ragged_samples([3, 5, 2])
    density = torch.zeros(10)
    density[5] = float("nan")
    _, (t, _, ray, _), _ = filter_visible(density * samples.dt, packed(samples), 1e-4, 0.01)
    assert float(samples.t[5]) in t.tolist() and (ray == 1).any()
