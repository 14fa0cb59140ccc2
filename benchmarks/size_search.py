"""Sizes: what the search for the smallest model chooses on scenes of rising complexity, against every rung trained in full."""

import argparse
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import torch
from torch import Tensor

from benchmarks.tables import Rows, name_tables
from nerf_lightning.cli.rightsize import describe_scene, rightsize
from nerf_lightning.config.build import build_data
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import RayDataModule, save_npz
from nerf_lightning.sizing.choose import read_ladder
from nerf_lightning.sizing.search import train_full_run
from nerf_lightning.synthetic.objects import Box, Primitive, Sphere, make_object_scene

SIZE, VIEWS, HELD_OUT = 200, 100, 10
"""As of bricks and Lego, so that scenes differ in what they show alone."""
NUM_BODIES, GRAIN = 80, 12.0
"""In the heap, and how fine the pattern on them is: waves of 5 pixels and more."""
FEW_VIEWS = 6
"""Training views that a scene is left with, to see whether its model shrinks too."""


def make_heap(count: int = NUM_BODIES, seed: int = 0) -> list[Primitive]:
    """Balls and blocks, thrown together within about 1 of the origin."""
    generator = torch.Generator().manual_seed(seed)
    bodies: list[Primitive] = []
    for index in range(count):
        x, y, z, size = (torch.rand(4, generator=generator) * 2 - 1).tolist()
        (x, y, z), radius = (0.75 * x, 0.75 * y, 0.6 * z), 0.14 + 0.06 * size
        low, high = (x - radius, y - radius, z - radius), (x + radius, y + radius, z + radius)
        bodies.append(Sphere((x, y, z), radius, GRAIN) if index % 2 else Box(low, high, GRAIN))
    return bodies


def measure(args: argparse.Namespace) -> Rows:
    """Two tables: for each scene the choice, and all rungs of the ladder trained in full; Lego with few views."""
    overrides, seconds, output = args.overrides, args.budgets[0], args.output
    scenes, folder = {"sphere": "", "bricks": "bricks", "heap": "", "lego": "lego"}, output / "scenes"
    folder.mkdir(parents=True, exist_ok=True)
    made: dict[str, list[Primitive]] = {"sphere": [Sphere((0.0, 0.0, 0.0), 0.8, frequency=0.0)], "heap": make_heap()}
    for name, bodies in made.items():
        scenes[name] = str(folder / f"{name}.npz")
        save_npz(make_object_scene(bodies, size=SIZE, views=VIEWS, held_out=HELD_OUT), Path(scenes[name]))
    given = ["recipe=tensorf_medium", f"budget.seconds={seconds}", "callbacks.orbit=null", *overrides]
    rungs = read_ladder("tensorf").rungs
    rows: Rows = []
    few: Rows = []
    for name, scene in scenes.items():
        place = output / "sizes" / name
        found = rightsize(scene, *given, output=place)
        cfg = compose_config([*describe_scene(scene), *given], place)
        data = build_data(cfg)
        assert isinstance(data, RayDataModule)  # scenes alone are measured
        full = [train_full_run(cfg, rung, found["sampler"], data, place / f"rung_{i}") for i, rung in enumerate(rungs)]
        mine = full[found["rung"]]
        row = {"scene": name, "picture_kB": measure_png_bytes(data.scene.val.images) / 1000, "rung": found["rung"]}
        row |= {"kB": found["artifact_bytes"] / 1000, "psnr": mine.psnr}
        row |= {"below_best": max(one.psnr for one in full) - mine.psnr}
        row |= {"share_of_largest": mine.size / max(one.size for one in full)}
        row |= {"search_ratio": found["search_seconds"] / mine.seconds}
        rows.append({**row, "rungs": " ".join(f"{one.psnr:.1f}/{one.size / 1000:.0f}" for one in full)})
    path = folder / f"{name}_{FEW_VIEWS}.npz"
    assert isinstance(data, RayDataModule)  # of the last of them
    save_npz(replace(data.scene, train=data.scene.train.subsample(FEW_VIEWS)), path)
    sparse = compose_config([*describe_scene(str(path)), *given], output)
    for views, of, result in (
        (VIEWS, cfg, found),
        (FEW_VIEWS, sparse, rightsize(str(path), *given, output=output / "sizes" / path.stem)),
    ):
        chosen = result["full"][str(result["rung"])]
        default = train_full_run(of, {}, {}, build_data(of), output / "sizes" / f"default_{views}")
        row = {"views": views, "rung": result["rung"], "kB": chosen["size"] / 1000, "psnr": chosen["psnr"]}
        few.append({**row, "default_kB": default.size / 1000, "default_psnr": default.psnr})
    return name_tables({"sizes": rows, "few": few})


def measure_png_bytes(images: Tensor) -> float:
    """Mean bytes of images [V, H, W, C] as PNG: how complex a scene is, told without a field."""
    return sum(len(imageio.imwrite("<bytes>", image.numpy(), extension=".png")) for image in images) / len(images)
