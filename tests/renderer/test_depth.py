"""The median depth: exact for a density that is constant within each interval."""

import math

import pytest
import torch

from nerf_lightning.renderer.depth import median_depth
from tests.helpers.ragged_samples import COUNTS, ragged_samples


@pytest.mark.parametrize("counts", COUNTS[1:3])
def test_median_depth_halves_opacity(counts: list[int]):
    samples = ragged_samples(counts, torch.float64)
    density = 4 * torch.rand(len(samples), dtype=torch.float64)

    def before(ray: int, distance: float) -> float:
        """The opacity up to a distance, interval by interval."""
        own = slice(samples.offsets[ray], samples.offsets[ray + 1])
        start = samples.t[own] - samples.dt[own] / 2
        return 1 - math.exp(-float((density[own] * (distance - start).clamp_min(0).minimum(samples.dt[own])).sum()))

    opacity = torch.tensor([before(ray, math.inf) for ray in range(len(counts))], dtype=torch.float64)
    depth = median_depth(density, opacity, samples)
    for ray, count in enumerate(counts):
        if count:
            assert before(ray, float(depth[ray])) == pytest.approx(float(opacity[ray]) / 2, rel=1e-6)
        else:
            assert depth[ray] == 0


def test_median_depth_ignores_long_last_interval():
    samples = ragged_samples([3])
    samples.dt[2], samples.t[2] = 1000, 500
    density = torch.tensor([0.0, 1e3, 1e-5])
    depth = median_depth(density, torch.tensor([0.99]), samples)
    assert abs(float(depth) - float(samples.t[1])) < float(samples.dt[1])
