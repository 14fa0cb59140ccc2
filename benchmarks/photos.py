"""Photo robustness: mixed sizes, occluders with and without masks, and a fisheye lens, against clean photos."""

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean

import torch

import nerf_lightning as nl
from benchmarks.tables import Rows
from nerf_lightning.cameras import Cameras, Distortion, Lenses, Projection
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.synthetic.objects import (
    PILE,
    bound_primitives,
    make_hemisphere_cameras,
    make_object_scene,
    render_photos,
)

SIZE, VIEWS, HELD_OUT = 128, 48, 6
STEPS = 1500
GRAY = (0.5, 0.5, 0.5)
BOXED_FRACTION = 0.3
"""Fraction of the training photos with pasted boxes."""
FISHEYE = Distortion(k1=-0.02, k2=0.004)
DISABLED_OUTPUTS = ("callbacks.snapshots=null", "callbacks.orbit=null", "~logger", "callbacks.validation=null")


def concatenate_views(parts: Sequence[Views]) -> Views:
    """Concatenates views of different sizes."""
    K, c2w, sizes = (torch.cat([getattr(part.cameras, name) for part in parts]) for name in ("K", "c2w", "sizes"))
    return Views(torch.cat([part.pixels for part in parts]), Cameras(K, c2w, sizes))


def crop_views(views: Views, left: int, top: int) -> Views:
    """Crops photos by margins in pixels on both sides."""
    cameras = views.cameras
    K = cameras.K.clone()
    K[:, 0, 2] -= left
    K[:, 1, 2] -= top
    width, height = cameras.width - 2 * left, cameras.height - 2 * top
    images = views.images[:, top : top + height, left : left + width]
    return Views.from_images(images.contiguous(), Cameras.pinhole(K, cameras.c2w, width, height))


def resize_views(scene: Scene) -> Scene:
    """Makes a third of the training photos landscape, a third portrait, and a third half as large."""
    train = scene.train
    thirds = [train[torch.arange(first, len(train), 3)] for first in range(3)]
    small = thirds[2].cameras.rescale(0.5)
    halved = Views.from_images(render_photos(PILE, small, scene.background), small)
    margin = SIZE // 8
    cropped = crop_views(thirds[0], 0, margin), crop_views(thirds[1], margin, 0)
    return replace(scene, train=concatenate_views([*cropped, halved]))


def paste_boxes(scene: Scene, seed: int) -> tuple[Scene, Scene]:
    """Pastes random boxes over some training photos; returns the scene without and with their masks."""
    generator = torch.Generator().manual_seed(seed)
    images = scene.train.images.clone()
    valid = torch.ones(images.shape[:3], dtype=torch.bool)
    for view in torch.randperm(len(images), generator=generator)[: round(BOXED_FRACTION * len(images))].tolist():
        for _ in range(3):
            top, left = torch.randint(SIZE, (2,), generator=generator).tolist()
            height, width = torch.randint(SIZE // 5, SIZE // 2, (2,), generator=generator).tolist()
            box = slice(top, top + height), slice(left, left + width)
            images[view][box] = torch.randint(256, (3,), generator=generator).to(torch.uint8)
            valid[view][box] = False
    occluded = Views.from_images(images, scene.train.cameras)
    masked = replace(occluded, valid_mask=valid.flatten())
    return replace(scene, train=occluded), replace(scene, train=masked)


def render_fisheye(views: int, phase: float) -> Views:
    """Renders fisheye photos with the field of view of `make_hemisphere_cameras`."""
    pinhole = make_hemisphere_cameras(views, SIZE, phase)
    K = pinhole.K.clone()
    half = math.atan(float(0.5 * SIZE / K[0, 0, 0]))
    focal = 0.5 * SIZE / (half * (1 + FISHEYE.k1 * half**2 + FISHEYE.k2 * half**4))
    K[:, 0, 0] = K[:, 1, 1] = focal
    lenses = Lenses(torch.tensor([FISHEYE]).repeat(views, 1), torch.full((views,), Projection.FISHEYE))
    cameras = Cameras(K, pinhole.c2w, pinhole.sizes, lenses)
    return Views.from_images(render_photos(PILE, cameras, GRAY), cameras)


def measure(args: argparse.Namespace) -> Rows:
    """Trains on each kind of photos; one row per kind."""
    plain = replace(make_object_scene(PILE, GRAY, SIZE, VIEWS, HELD_OUT), bounds=bound_primitives(PILE))
    boxes, masks = paste_boxes(plain, args.seeds[0])
    fisheye = replace(plain, train=render_fisheye(VIEWS, 0.0), val=render_fisheye(HELD_OUT, 0.7))
    scenes = {"one size": plain, "several sizes": resize_views(plain)}
    scenes |= {"boxes": boxes, "boxes, masked": masks, "fisheye": fisheye}
    rows: Rows = []
    for name, scene in scenes.items():
        psnrs = []
        for seed in args.seeds:
            print(f"photos: {name}, seed {seed}", flush=True)
            folder = args.output / "photos" / f"{name}_{seed}".replace(" ", "_")
            run = nl.train(scene, steps=STEPS, seed=seed, device="cpu", folder=folder, options=DISABLED_OUTPUTS)
            psnrs.append(run.psnr)
        bytes_per_pixel = scene.train.nbytes / len(scene.train.pixels)
        rows.append({"photos": name, "psnr": fmean(psnrs), "bytes/pixel": bytes_per_pixel})
    return rows
