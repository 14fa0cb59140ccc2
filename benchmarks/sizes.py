"""Sizes: what the search for the smallest model chooses on scenes of rising complexity, against every rung trained in full."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import torch
from omegaconf import DictConfig
from torch import Tensor

from benchmarks.tables import Rows, named
from nerf_lightning.config import conf_dir
from nerf_lightning.config.build import build_data
from nerf_lightning.config.compose import composed
from nerf_lightning.dataset import RayDataModule, save_npz
from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.drawing.panels import write_png
from nerf_lightning.rightsize.choose import Target
from nerf_lightning.rightsize.ladder import read_ladder
from nerf_lightning.rightsize.report import chart
from nerf_lightning.rightsize.search import Found, Full, search, train_in_full
from nerf_lightning.stability.toys import Ball, Block, Body, toy
from nerf_lightning.utils.text import subsample

SIZE, VIEWS, HELD_OUT = 200, 100, 10
"""As of bricks and Lego, so that scenes differ in what they show alone."""
BODIES, GRAIN = 80, 12.0
"""In the heap, and how fine the pattern on them is: waves of 5 pixels and more."""
FEW = 6
"""Training views that a scene is left with, to see whether its model shrinks too."""
NEAR = 0.3
"""dB that the choice may be below the best."""


def heap(count: int = BODIES, seed: int = 0) -> list[Body]:
    """Balls and blocks, thrown together within about 1 of the origin."""
    generator = torch.Generator().manual_seed(seed)
    bodies: list[Body] = []
    for index in range(count):
        x, y, z, size = (torch.rand(4, generator=generator) * 2 - 1).tolist()
        centre, radius = (0.75 * x, 0.75 * y, 0.6 * z), 0.14 + 0.06 * size
        low, high = (tuple(c + sign * radius for c in centre) for sign in (-1, 1))
        bodies.append(Ball(centre, radius) if index % 2 else Block(low, high))
    return bodies


def scenes(folder: Path) -> dict[str, list[str]]:
    """Overrides of each scene's dataset, the simplest first."""
    made = {
        "sphere": toy([Ball((0.0, 0.0, 0.0), 0.8)], size=SIZE, views=VIEWS, held_out=HELD_OUT, grain=0.0),
        "heap": toy(heap(), size=SIZE, views=VIEWS, held_out=HELD_OUT, grain=GRAIN),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, scene in made.items():
        save_npz(scene, folder / f"{name}.npz")
    paths = {name: ["dataset=photos", f"dataset.path={folder}/{name}.npz"] for name in made}
    return {"sphere": paths["sphere"], "bricks": ["dataset=bricks"], "heap": paths["heap"], "lego": ["dataset=lego"]}


def configured(dataset: list[str], seconds: float, overrides: list[str], folder: Path) -> DictConfig:
    """A run on a scene: planes and lines of the default size."""
    given = [*dataset, "recipe=tensorf_medium", f"budget.seconds={seconds}", "callbacks.orbit=null", *overrides]
    return composed(given, folder)


def looked_for(cfg: DictConfig, folder: Path) -> Found:
    """What the search finds, with its report."""
    ladder = read_ladder(str(cfg.method), conf_dir() / "ladders")
    found = search(cfg, Target(within_db=NEAR), ladder, folder)
    write_png(folder / "chart.png", pixels_of(chart(found)))
    return found


def measure(args: argparse.Namespace) -> Rows:
    """Two tables: for each scene the choice, and all rungs of the ladder trained in full; the last scene with few views."""
    overrides, seconds, output = args.overrides, args.budgets[0], args.output
    rows: Rows = []
    last: tuple[DictConfig, Found] | None = None
    for name, dataset in scenes(output / "scenes").items():
        folder = output / "sizes" / name
        cfg = configured(dataset, seconds, overrides, folder)
        found = looked_for(cfg, folder)
        data = build_data(cfg)
        full = {
            index: found.full.get(index) or train_in_full(cfg, options, found.sampler, data, folder / f"rung_{index}")
            for index, options in enumerate(found.ladder.rungs)
        }
        assert isinstance(data, RayDataModule)  # scenes alone are measured
        rows.append({"scene": name, "picture_kB": png_size(data.scene.val.images) / 1000, **_row(found, full)})
        last = cfg, found
    assert last is not None  # there are scenes
    return named({"sizes": rows, "few": few(*last, overrides, seconds, output)})


def png_size(images: Tensor) -> float:
    """Mean bytes of pictures [V, H, W, C] as PNG: how complex a scene is, told without a field."""
    return sum(len(imageio.imwrite("<bytes>", image.numpy(), extension=".png")) for image in images) / len(images)


def few(whole: DictConfig, found: Found, overrides: list[str], seconds: float, output: Path) -> Rows:
    """The choice for a scene with all its views and with few, beside the default size."""
    data = build_data(whole)
    assert isinstance(data, RayDataModule)  # scenes alone are measured
    folder = output / "sizes" / f"{data.scene.name}_{FEW}"
    kept = torch.tensor(subsample(len(data.scene.train), FEW))
    views = data.scene.train
    path = output / "scenes" / f"{data.scene.name}_{FEW}.npz"
    save_npz(replace(data.scene, train=views[torch.as_tensor(kept)]), path)
    cfg = configured(["dataset=photos", f"dataset.path={path}"], seconds, overrides, folder)
    sparse = looked_for(cfg, folder)
    rows: Rows = []
    for count, of, one in ((len(views), whole, found), (FEW, cfg, sparse)):
        mine = one.full[one.choice]
        default = train_in_full(of, {}, {}, build_data(of), folder / f"default_{count}")
        row = {"views": count, "rung": one.choice, "kB": mine.size / 1000, "psnr": mine.psnr}
        rows.append({**row, "default_kB": default.size / 1000, "default_psnr": default.psnr})
    return rows


def _row(found: Found, full: dict[int, Full]) -> dict[str, Any]:
    mine, best = full[found.choice], max(one.psnr for one in full.values())
    return {
        "rung": found.choice,
        "kB": len(found.compact.content) / 1000,
        "psnr": mine.psnr,
        "below_best": best - mine.psnr,
        "share_of_largest": mine.size / max(one.size for one in full.values()),
        "search_ratio": found.seconds / mine.seconds,
        "rungs": " ".join(f"{one.psnr:.1f}/{one.size / 1000:.0f}" for one in full.values()),
    }
