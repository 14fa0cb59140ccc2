import math

import pytest
import torch

from nerf_lightning.kernels import composite, keep_visible
from nerf_lightning.sampler import Samples
from tests.helpers.ragged_samples import MANY, ragged_samples


def packed(samples: Samples):
    return samples.t, samples.dt, samples.ray, samples.offsets


@pytest.mark.parametrize(
    ("counts", "early_stop_eps", "min_thickness", "dropped"),
    [
        ([3, 0, 5, 1], 1e-4, 0.0, math.inf),
        ([0], 1e-4, 0.2, math.inf),
        ([30, 0, 2, 11, 0], 1e-4, 0.2, math.inf),
        ([30, 0, 2, 11, 0], 0.5, 0.0, math.inf),
        ([30, 0, 2, 11, 0], 1e-4, 0.2, 0.3),
    ],
)
def test_keep_visible_any_threshold_matches_loop_over_samples(
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


def test_keep_visible_pixels_change_within_threshold():
    samples = ragged_samples(MANY)
    density, rgb = 20 * torch.rand(len(samples)) ** 4, torch.rand(len(samples), 3)
    whole = composite(density, rgb, *packed(samples))
    _, (t, dt, ray, offsets) = keep_visible(density * samples.dt, packed(samples), 1e-3, 0.0)
    assert 0 < len(t) < len(samples)
    place = {key: i for i, key in enumerate(zip(samples.ray.tolist(), samples.t.tolist(), strict=True))}
    index = torch.tensor([place[key] for key in zip(ray.tolist(), t.tolist(), strict=True)])
    part = composite(density[index], rgb[index], t, dt, ray, offsets)
    assert 0 < (whole[0] - part[0]).abs().max() <= 1e-3 and (whole[1] - part[1]).abs().max() <= 1e-3


def test_keep_visible_nan_density_stays(kernels: str):
    samples = ragged_samples([3, 5, 2])
    density = torch.zeros(10)
    density[5] = float("nan")
    _, (t, _, ray, _) = keep_visible(density * samples.dt, packed(samples), 1e-4, 0.01)
    assert float(samples.t[5]) in t.tolist() and (ray == 1).any()
