import pytest
import torch

from nerf_lightning.cameras import Rays
from nerf_lightning.sampler import Samples, pack


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_pack_keeps_chosen_intervals_ray_by_ray(share: float):
    edges = torch.rand(13, 8).cumsum(1)
    keep = torch.rand(13, 7) < share
    t, dt, ray, offsets = [], [], [], [0]
    for r in range(13):
        for i in range(7):
            if keep[r, i]:
                start, end = float(edges[r, i]), float(edges[r, i + 1])
                t.append((start + end) / 2)
                dt.append(end - start)
                ray.append(r)
        offsets.append(len(t))
    samples = pack(edges, keep)
    assert len(samples) == len(t)
    assert samples.ray.tolist() == ray and samples.offsets.tolist() == offsets
    torch.testing.assert_close(samples.t, torch.tensor(t))
    torch.testing.assert_close(samples.dt, torch.tensor(dt), rtol=1e-4, atol=1e-6)


def test_samples_positions_lie_on_own_rays():
    rays = Rays(torch.tensor([[0.0, 0, 0], [1, 2, 3]]), torch.tensor([[1.0, 0, 0], [0, 0.6, 0.8]]))
    t, ray = torch.tensor([2.0, 5.0, 10.0]), torch.tensor([0, 1, 1])
    samples = Samples(t, torch.ones(3), ray, torch.tensor([0, 1, 3]))
    torch.testing.assert_close(samples.positions(rays), torch.tensor([[2.0, 0, 0], [1, 5, 7], [1, 8, 11]]))
    assert torch.equal(samples.directions(rays), rays.directions[[0, 1, 1]])
