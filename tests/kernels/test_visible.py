import math

import pytest
import torch

from nerf_lightning.kernels import composite, keep_visible, use_kernels
from nerf_lightning.sampler import Samples
from tests.helpers.assert_close import run_with_threads
from tests.helpers.ragged_samples import COUNTS, MANY, ragged_samples


def packed(samples: Samples):
    return samples.t, samples.dt, samples.ray, samples.offsets


def flat(kept):
    thickness, packed = kept
    return thickness, *packed


@pytest.mark.parametrize("counts", COUNTS)
@pytest.mark.parametrize("early_stop_eps", [1e-4, 0.5])
@pytest.mark.parametrize(("min_thickness", "dropped"), [(0.0, math.inf), (1e-3, math.inf), (0.2, math.inf), (0.2, 0.3)])
def test_what_is_seen_agrees_with_a_loop(
    counts: list[int], early_stop_eps: float, min_thickness: float, dropped: float, kernels: str
):
    samples = ragged_samples(counts)
    density = 20 * torch.rand(len(samples)) * (torch.rand(len(samples)) < 0.7)
    kept, ends, i = [], [0], 0
    for count in counts:
        transmittance, thin = 1.0, 0.0
        for _ in range(count):
            thickness = float(density[i]) * float(samples.dt[i])
            thin += thickness if thickness < min_thickness else 0.0
            if transmittance >= early_stop_eps and (thickness >= min_thickness or thin > dropped):
                kept.append(i)
            transmittance *= math.exp(-thickness)
            i += 1
        ends.append(len(kept))
    given = density * samples.dt, packed(samples), early_stop_eps, min_thickness
    thickness, (t, dt, ray, offsets) = keep_visible(*given, dropped=dropped)
    assert torch.equal(thickness, given[0][kept])
    assert torch.equal(t, samples.t[kept]) and torch.equal(dt, samples.dt[kept])
    assert torch.equal(ray, samples.ray[kept]) and offsets.tolist() == ends


@pytest.mark.parametrize("counts", [[], [0, 0], MANY])
@pytest.mark.parametrize(("min_thickness", "dropped"), [(0.0, math.inf), (0.1, math.inf), (0.1, 0.2)])
def test_what_is_seen_agrees_with_the_reference(counts: list[int], min_thickness: float, dropped: float):
    samples = ragged_samples(counts)
    density = 30 * torch.rand(len(samples)) * (torch.rand(len(samples)) < 0.5)
    results = {}
    for choice in ("auto", "reference"):
        use_kernels(choice)
        results[choice] = flat(
            keep_visible(density * samples.dt, packed(samples), 1e-3, min_thickness, dropped=dropped)
        )
    assert all(torch.equal(a, b) for a, b in zip(*results.values(), strict=True))
    use_kernels("auto")
    one = run_with_threads(
        lambda: keep_visible(density * samples.dt, packed(samples), 1e-3, min_thickness, dropped=dropped), 1
    )
    assert all(torch.equal(a, b) for a, b in zip(flat(one), results["auto"], strict=True))


def test_nothing_is_dropped_when_all_may_stay(kernels: str):
    samples = ragged_samples(MANY)
    _, kept = keep_visible(torch.full((len(samples),), 1e-3), packed(samples), 1e-4, 0.1, dropped=1e-4)
    assert all(torch.equal(a, b) for a, b in zip(kept, packed(samples), strict=True))


def test_dropping_what_is_not_seen_changes_pixels_by_no_more_than_it_may():
    samples = ragged_samples(MANY)
    density, rgb = 20 * torch.rand(len(samples)) ** 4, torch.rand(len(samples), 3)
    whole = composite(density, rgb, *packed(samples))
    _, (t, dt, ray, offsets) = keep_visible(density * samples.dt, packed(samples), 1e-3, 0.0)
    assert 0 < len(t) < len(samples)
    place = {key: i for i, key in enumerate(zip(samples.ray.tolist(), samples.t.tolist(), strict=True))}
    index = torch.tensor([place[key] for key in zip(ray.tolist(), t.tolist(), strict=True)])
    part = composite(density[index], rgb[index], t, dt, ray, offsets)
    assert 0 < (whole[0] - part[0]).abs().max() <= 1e-3 and (whole[1] - part[1]).abs().max() <= 1e-3


def test_a_density_that_is_not_a_number_stays(kernels: str):
    samples = ragged_samples([3, 5, 2])
    density = torch.zeros(10)
    density[5] = float("nan")
    _, (t, _, ray, _) = keep_visible(density * samples.dt, packed(samples), 1e-4, 0.01)
    assert float(samples.t[5]) in t.tolist() and (ray == 1).any()
