"""Objects of six kinds before a plain background: held-out PSNR of each recipe."""

import argparse
from contextlib import suppress
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from benchmarks import methods
from benchmarks.synthetic.part_tracer import Tracer
from benchmarks.synthetic.parts import OBJECTS
from benchmarks.tables import Rows
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.objects import make_hemisphere_cameras
from nerf_lightning.utils.files import atomic_write, cache_folder
from nerf_lightning.utils.parsing import read_npz

RECIPES = ["tensorf_medium", "hashgrid_medium"]
CACHE_VERSION = 1
"""Version in the cache's file names: increment it when objects, shading or cameras change."""
TRAIN_VIEWS, VAL_VIEWS = 100, 10


def render_object(name: str, size: int) -> Path:
    """Renders an object in the course format with alpha, or finds it in the cache."""
    path = cache_folder() / f"object-{name}-v{CACHE_VERSION}-{size}px.npz"
    with suppress(InputError, KeyError):  # missing or damaged: render again
        read_npz(path, ["images_train"])["images_train"]
        return path
    print(f"objects: rendering {path}", flush=True)
    train, val = make_hemisphere_cameras(TRAIN_VIEWS, size), make_hemisphere_cameras(VAL_VIEWS, size, 0.7)
    tracer, arrays = Tracer(OBJECTS[name](np.random.default_rng(0))), dict[str, Any]()
    for split, views in (("train", train), ("val", val)):
        arrays[f"images_{split}"] = np.stack([tracer.render(views, view) for view in range(len(views))])
        arrays[f"c2ws_{split}"] = views.c2w.numpy()
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, K=train.K[0].numpy(), background=np.ones(3), **arrays)
    return path


def measure(args: argparse.Namespace) -> Rows:
    """Trains each recipe on each object; one row per recipe, with the mean over seeds of each object's PSNR."""
    files, rows = {name: render_object(name, args.size) for name in OBJECTS}, Rows()
    for recipe in args.recipes or RECIPES:
        quality = {}
        for name, path in files.items():
            options = [f"dataset.path='{path}'", "dataset.resize=null", f"recipe={recipe}", *args.overrides]
            options += [f"budget.seconds={args.budgets[0]}", f"device={args.device.type}"]
            runs = []
            for seed in args.seeds:
                folder = args.output / "objects" / f"{name}_{recipe}_{seed}"
                runs.append(methods.train("lego", options, seed, folder)["psnr"])
                print(f"objects: {name}, {recipe}, seed {seed}: {runs[-1]:.2f} dB", flush=True)
            quality[name] = fmean(runs)
        rows.append({"recipe": recipe, **quality, "mean": fmean(quality.values())})
    return rows
