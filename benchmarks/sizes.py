"""Sizes: what the search for the smallest model chooses on scenes of rising complexity, against every rung trained in full."""

from pathlib import Path
from typing import Any

import torch

from nerf_lightning import cli
from nerf_lightning.build import build_data
from nerf_lightning.compose import composed
from nerf_lightning.dataset import save_npz
from nerf_lightning.rightsize.choose import Target
from nerf_lightning.rightsize.ladder import read_ladder
from nerf_lightning.rightsize.search import Found, Full, search, train_in_full
from nerf_lightning.stability.toys import Ball, Block, Body, toy

SIZE, VIEWS, HELD_OUT = 120, 60, 8
BODIES = 40
"""In the heap."""
NEAR = 0.3
"""dB that the choice may be below the best."""

Rows = list[dict[str, Any]]


def heap(count: int = BODIES, seed: int = 0) -> list[Body]:
    """Balls and blocks, thrown together within about 1 of the origin."""
    generator = torch.Generator().manual_seed(seed)
    bodies: list[Body] = []
    for index in range(count):
        x, y, z, size = (torch.rand(4, generator=generator) * 2 - 1).tolist()
        centre, radius = (0.7 * x, 0.7 * y, 0.6 * z), 0.16 + 0.08 * size
        low, high = (tuple(c + sign * radius for c in centre) for sign in (-1, 1))
        bodies.append(Ball(centre, radius) if index % 2 else Block(low, high))
    return bodies


def scenes(folder: Path) -> dict[str, list[str]]:
    """Overrides of each scene's dataset, the simplest first."""
    made = {
        "sphere": toy([Ball((0.0, 0.0, 0.0), 0.8)], size=SIZE, views=VIEWS, held_out=HELD_OUT, grain=0.0),
        "heap": toy(heap(), size=SIZE, views=VIEWS, held_out=HELD_OUT, grain=4.0),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, scene in made.items():
        save_npz(scene, folder / f"{name}.npz")
    paths = {name: ["dataset=photos", f"dataset.path={folder}/{name}.npz"] for name in made}
    return {"sphere": paths["sphere"], "bricks": ["dataset=bricks"], "heap": paths["heap"], "lego": ["dataset=lego"]}


def measure(overrides: list[str], seconds: float, output: Path) -> dict[str, Rows]:
    """A table: for each scene the choice, and all rungs of the ladder trained in full."""
    rows: Rows = []
    for name, dataset in scenes(output / "scenes").items():
        folder = output / "sizes" / name
        given = [*dataset, "recipe=tensorf_medium", f"budget.seconds={seconds}", "callbacks.orbit=null", *overrides]
        cfg = composed(given, folder)
        ladder = read_ladder(str(cfg.method), cli.conf_dir() / "ladders")
        found = search(cfg, Target(within_db=NEAR), ladder, folder)
        data = build_data(cfg)
        full = {
            index: found.full.get(index) or train_in_full(cfg, options, found.sampler, data, folder / f"rung_{index}")
            for index, options in enumerate(ladder.rungs)
        }
        rows.append({"scene": name, **_row(found, full)})
    return {"sizes": rows}


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
