"""A custom loss, here the entropy of opacity: rays hit either the content or the background.

python examples/own_loss.py SCENE.npz 1000
"""

import sys
from functools import partial

import lightning as L
import torch

import nerf_lightning as nl
from nerf_lightning import dataset, model, renderer, sampler, system


class EntropyNeRF3D(system.NeRF3D):
    def regularize(self, output, samples, batch):
        o = output.opacity.clamp(1e-3, 1 - 1e-3)
        entropy = -(o * o.log() + (1 - o) * (1 - o).log()).mean()
        return {**super().regularize(output, samples, batch), "entropy": 1e-3 * entropy}


if __name__ == "__main__":
    scene = nl.load_scene(sys.argv[1])
    data, box = dataset.RayDataModule(scene), scene.bounds
    volume_renderer = renderer.VolumeRenderer(scene_background=scene.background)
    optimizer = partial(torch.optim.Adam, lr=0.01)
    nerf = EntropyNeRF3D(
        model.HashGridField(box), sampler.OccupancySampler(box), volume_renderer, optimizer, system.exponential
    )
    L.Trainer(max_steps=int(sys.argv[2]), accelerator="cpu", logger=False, enable_checkpointing=False).fit(nerf, data)
    print(f"{nerf.evaluate(data.get_held_out_view(0)).psnr:.2f} dB on a held-out view")
