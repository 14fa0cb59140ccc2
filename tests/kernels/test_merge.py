import math

import pytest
import torch

from nerf_lightning.kernels import composite, merge_faint
from nerf_lightning.sampler import Samples
from tests.helpers.ragged_samples import MANY, ragged_samples

FAINT = 0.1


def packed(samples: Samples):
    return samples.t, samples.dt, samples.ray, samples.offsets


def foggy(counts: list[int]) -> tuple[torch.Tensor, Samples]:
    """Thickness and samples, of which some stand alone."""
    samples = ragged_samples(counts)
    keep = torch.rand(len(samples)) < 0.8
    ends = torch.cat([torch.zeros(1, dtype=torch.int64), keep.cumsum(0)])[samples.offsets]
    some = Samples(samples.t[keep], samples.dt[keep], samples.ray[keep], ends)
    return 2 * torch.rand(len(some)) ** 3, some


def by_hand(thickness: torch.Tensor, samples: Samples, faint: float) -> list[tuple[float, ...]]:
    """Thickness, t, dt and ray of what remains."""
    found: list[tuple[float, ...]] = []
    for ray in range(len(samples.offsets) - 1):
        passed, last, weight_before = 0.0, None, 0.0
        for n in range(int(samples.offsets[ray]), int(samples.offsets[ray + 1])):
            own, t, dt = (float(x[n]) for x in (thickness, samples.t, samples.dt))
            weight = math.exp(-passed) * (1 - math.exp(-own))
            passed += own
            touches = last is not None and (t - dt / 2) - (last[1] + last[2] / 2) < 0.02
            if touches and min(weight, weight_before) < faint:
                both = weight + weight_before
                found[-1] = (own + last[0], (weight * t + weight_before * last[1]) / both, dt + last[2], ray)
                last = None  # at most two
            else:
                found.append((own, t, dt, ray))
                last = own, t, dt
            weight_before = weight
    return found


@pytest.mark.parametrize(("counts", "faint"), [([0], FAINT), ([30, 0, 2, 11, 0], 0.0), (MANY, FAINT), (MANY, 1.1)])
def test_merge_faint_neighbours_match_loop_over_samples(counts: list[int], faint: float, kernels: str):
    thickness, samples = foggy(counts)
    merged, (t, dt, ray, offsets) = merge_faint(thickness, packed(samples), faint)
    wanted = by_hand(thickness, samples, faint)
    torch.testing.assert_close(torch.stack([merged, t, dt, ray.float()], dim=1), torch.tensor(wanted).view(-1, 4))
    assert torch.equal(offsets.diff(), torch.bincount(ray, minlength=len(counts)))
    assert len(t) < len(samples) or faint == 0 or len(samples) < 20


def test_merge_faint_pixels_hardly_change(kernels: str):
    thickness, samples = foggy(MANY)
    merged, (t, dt, ray, offsets) = merge_faint(thickness, packed(samples), 0.01)

    def seen(thickness, t, dt, ray, offsets):
        rgb = torch.stack([t, t.square(), torch.sin(t)], dim=1) / 25  # within [0, 1]
        return composite(thickness / dt, rgb, t, dt, ray, offsets)

    whole, part = seen(thickness, *packed(samples)), seen(merged, t, dt, ray, offsets)
    assert len(t) < 0.9 * len(samples)
    torch.testing.assert_close(whole[1:], part[1:], rtol=1e-5, atol=1e-5)
    assert 0 < (whole[0] - part[0]).abs().max() < 0.01
