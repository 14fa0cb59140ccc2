"""Trains a field for some seconds, and renders a held-out view next to its photo.

python examples/train_and_render.py SCENE.npz 15
"""

import sys

import imageio.v3 as imageio
import torch

import nerf_lightning as nl

if __name__ == "__main__":
    scene = nl.load_scene(sys.argv[1])
    run = nl.train(scene, recipe="tensorf_medium", seconds=float(sys.argv[2]))
    print(f"{run.psnr:.2f} dB on held-out views")
    render = run.render(scene.val.cameras[0]).rgb
    photo = scene.val.images[0, ..., :3].float() / 255
    imageio.imwrite("view.png", (255 * torch.cat([render, photo], dim=1)).round().byte().numpy())
    run.export.compact(output="field.npz")
