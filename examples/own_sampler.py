"""A custom sampler, here steps that grow with the distance, trained by Lightning's Trainer.

python examples/own_sampler.py SCENE.npz 1000
"""

import sys
from functools import partial

import lightning as L
import torch

import nerf_lightning as nl
from nerf_lightning import dataset, model, renderer, sampler, system


class Geometric(sampler.Sampler):
    def forward(self, rays, density, generator=None):
        near, far = self.bounds.near_far(rays)
        near, hit = near.clamp_min(1e-2 * self.bounds.max_half_size)[:, None], (far > near)[:, None]
        shift = torch.zeros(len(rays), 1) if generator is None else torch.rand(len(rays), 1, generator=generator)
        s = ((torch.arange(97) - shift) / 96).clamp(0, 1)
        edges = near * (far[:, None].maximum(near) / near) ** s
        return sampler.pack(edges, hit.expand(-1, 96))


if __name__ == "__main__":
    scene = nl.load_scene(sys.argv[1])
    data, box = dataset.RayDataModule(scene), scene.bounds
    volume_renderer = renderer.VolumeRenderer(scene_background=scene.background)
    optimizer = partial(torch.optim.Adam, lr=0.01)
    nerf = system.NeRF3D(model.HashGridField(box), Geometric(box), volume_renderer, optimizer, system.exponential)
    L.Trainer(max_steps=int(sys.argv[2]), accelerator="cpu", logger=False, enable_checkpointing=False).fit(nerf, data)
    print(f"{nerf.evaluate(data.get_held_out_view(0)).psnr:.2f} dB on a held-out view")
