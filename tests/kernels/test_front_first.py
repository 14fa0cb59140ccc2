import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import front_first, keep_visible, march, use_kernels
from nerf_lightning.kernels.march import Packed
from tests.helpers.assert_close import run_with_threads

CUBE = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
EPS = 0.01
STEP = 2 * math.sqrt(3) / 100


def shells(positions: Tensor) -> Tensor:
    """Fog in shells, and nothing between them."""
    return 40 * (12 * positions.norm(dim=1)).sin().clamp_min(0)


def looked(rays: Rays, occupied: Tensor) -> tuple[Tensor, Packed, int]:
    """Thickness and intervals, and how many positions were asked for."""
    asked = []

    def thickness(packed: Packed) -> Tensor:
        asked.append(len(packed[0]))
        t, dt, ray, _ = packed
        return shells(rays.origins.detach()[ray] + t[:, None] * rays.directions[ray]) * dt

    near, far = CUBE.near_far(rays)
    shift = torch.rand(near.shape, generator=torch.Generator().manual_seed(3))
    found, packed = front_first(rays, CUBE, near, far, shift, occupied, 100, STEP, thickness, EPS)
    return found, packed, sum(asked)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_front_first_any_occupancy_finds_visible_samples(share: float):
    directions = normalize(torch.randn(400, 3), dim=1)
    aside = torch.cat([torch.rand(396, 3) - 0.5, torch.full((4, 3), 5.0)])  # the last miss
    rays = Rays(aside - 4 * directions, directions)
    occupied = torch.rand(16**3) < share
    use_kernels("reference")
    expected, every, most = looked(rays, occupied)
    use_kernels("auto")
    found, packed, asked = looked(rays, occupied)
    for min_thickness in (0.0, 0.05):
        kept, which = keep_visible(found, packed, EPS, min_thickness)
        wanted, those = keep_visible(expected, every, EPS, min_thickness)
        assert all(torch.equal(a, b) for a, b in zip((kept, *which), (wanted, *those), strict=True))
    assert asked == len(found) and (len(found) < 0.7 * most or share < 1)
    again = run_with_threads(lambda: looked(rays, occupied), 2 if torch.get_num_threads() == 1 else 1)
    assert torch.equal(found, again[0]) and torch.equal(packed[0], again[1][0])


def test_front_first_rays_with_gradient_use_reference():
    rays = Rays(torch.tensor([[-3.0, 0.1, 0.2]], requires_grad=True), torch.tensor([[1.0, 0, 0]]))
    found, packed, asked = looked(rays, torch.ones(4**3, dtype=torch.bool))
    near, far = CUBE.near_far(rays)
    assert asked == len(march(rays, CUBE, near, far, torch.zeros(1), torch.ones(64, dtype=torch.bool), 100, STEP)[0])
