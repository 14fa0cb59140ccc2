import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds, Rays

LOW, HIGH = torch.tensor([-1.0, -1.5, -0.5]), torch.tensor([1.0, 0.5, 1.5])


@pytest.fixture
def box() -> Bounds:
    return Bounds(torch.stack([LOW, HIGH]))


@pytest.fixture
def rays() -> Rays:
    """60 rays from outside toward the box, some of which miss; 10 from inside; 1 that certainly misses."""
    origins = torch.cat([4 * normalize(torch.randn(60, 3), dim=-1), LOW + torch.rand(10, 3) * (HIGH - LOW)])
    toward = LOW + torch.rand(70, 3) * (HIGH - LOW) * 1.4
    directions = normalize(toward - origins, dim=-1)
    away = torch.tensor([[5.0, 5.0, 5.0]])
    return Rays(torch.cat([origins, away]), torch.cat([directions, normalize(away, dim=-1)]))
