from dataclasses import replace

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import mark_cells, points


def test_points_any_distance_lie_on_rays(kernels: str):
    origins, directions = torch.randn(40, 3), normalize(torch.randn(40, 3), dim=-1)
    ray, t = torch.randint(0, 40, (500,)), 5 * torch.rand(500)
    expected = [
        [o + d * x for o, d in zip(origins[r].tolist(), directions[r].tolist(), strict=True)]
        for r, x in zip(ray, t.tolist(), strict=True)
    ]
    found = points(origins, directions, ray, t)
    torch.testing.assert_close(found, torch.tensor(expected).view(-1, 3), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("unbounded", [False, True])
def test_mark_cells_marks_cells_of_samples(unbounded: bool, box: Bounds, rays: Rays, kernels: str):
    bounds, resolution = replace(box, unbounded=unbounded), 6
    ray, t = torch.randint(0, len(rays), (60,)), 6 * torch.rand(60)  # some of them outside
    marks = torch.full((resolution**3,), 3, dtype=torch.int32)
    positions = points(rays.origins, rays.directions, ray, t)
    mark_cells(marks, 7, bounds, positions)
    expected = torch.full_like(marks, 3)
    for place in positions:
        x, y, z = (int(min(max(float(u) * resolution, 0), resolution - 1)) for u in bounds.to_unit(place))
        expected[(x * resolution + y) * resolution + z] = 7
    assert torch.equal(marks, expected) and {3, 7} == set(marks.tolist())
    mark_cells(marks, 9, bounds, positions[:0])
    assert torch.equal(marks, expected), "no samples, no marks"
