"""A custom field, here a dense grid of density and color, trained by Lightning's Trainer.

python examples/own_field.py SCENE.npz 1000
"""

import sys
from functools import partial

import imageio.v3 as imageio
import lightning as L
import torch

import nerf_lightning as nl
from nerf_lightning import dataset, model, renderer, sampler, system


class Grid(model.Field):
    def __init__(self, bounds, cells=64):
        super().__init__(bounds)
        self.grid = torch.nn.Parameter(torch.zeros(1, 4, cells, cells, cells))

    def features(self, positions):
        grid_positions = 2 * self.bounds.to_unit(positions) - 1
        values = torch.nn.functional.grid_sample(self.grid, grid_positions[None, None, None], align_corners=True)
        return values[0, 0].flatten().exp(), values[0, 1:].flatten(1).T

    def color(self, features, directions):
        return torch.sigmoid(features)


if __name__ == "__main__":
    scene = nl.load_scene(sys.argv[1])
    data, box = dataset.RayDataModule(scene), scene.bounds
    volume_renderer = renderer.VolumeRenderer(scene_background=scene.background)
    optimizer = partial(torch.optim.Adam, lr=0.1)
    nerf = system.NeRF3D(Grid(box), sampler.OccupancySampler(box), volume_renderer, optimizer, system.exponential)
    L.Trainer(max_steps=int(sys.argv[2]), accelerator="cpu", logger=False, enable_checkpointing=False).fit(nerf, data)
    view = nerf.evaluate(data.get_held_out_view(0))
    print(f"{view.psnr:.2f} dB on a held-out view")
    imageio.imwrite("own_field.png", (255 * torch.cat([view.rgb, view.truth], dim=1)).round().byte().numpy())
