import torch

from nerf_lightning.sampler import pack


def test_pack_keeps_chosen_intervals_ray_by_ray():
    edges = torch.rand(13, 8).cumsum(1)
    keep = torch.rand(13, 7) < 0.5
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
