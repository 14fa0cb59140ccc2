"""Size search: the choice of `rightsize` on scenes of rising complexity, against every rung trained in full."""

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
"""Those of bricks and Lego, so that scenes differ in content only."""
NUM_BODIES, GRAIN = 80, 12.0
"""Primitives of the heap, and the frequency of their pattern: waves of 5 pixels and more."""
FEW_VIEWS = 6
"""Training views of the sparse scene."""


def make_heap(count: int = NUM_BODIES, seed: int = 0) -> list[Primitive]:
    """Makes a heap of spheres and boxes within about 1 of the origin."""
    generator = torch.Generator().manual_seed(seed)
    primitives: list[Primitive] = []
    for index in range(count):
        x, y, z, size = (torch.rand(4, generator=generator) * 2 - 1).tolist()
        (x, y, z), radius = (0.75 * x, 0.75 * y, 0.6 * z), 0.14 + 0.06 * size
        low, high = (x - radius, y - radius, z - radius), (x + radius, y + radius, z + radius)
        primitives.append(Sphere((x, y, z), radius, GRAIN) if index % 2 else Box(low, high, GRAIN))
    return primitives


def measure(args: argparse.Namespace) -> Rows:
    """Measures the choice and all rungs of each scene, and Lego with few views."""
    overrides, seconds, output = args.overrides, args.budgets[0], args.output
    scenes, folder = {"sphere": "", "bricks": "bricks", "heap": "", "lego": "lego"}, output / "scenes"
    folder.mkdir(parents=True, exist_ok=True)
    sphere: list[Primitive] = [Sphere((0.0, 0.0, 0.0), 0.8, frequency=0.0)]
    for name, primitives in (("sphere", sphere), ("heap", make_heap())):
        scenes[name] = str(folder / f"{name}.npz")
        save_npz(make_object_scene(primitives, size=SIZE, views=VIEWS, held_out=HELD_OUT), Path(scenes[name]))
    options = ["recipe=tensorf_medium", f"budget.seconds={seconds}", "callbacks.orbit=null", *overrides]
    rungs = read_ladder("tensorf").rungs
    rows, sparse_rows = Rows(), Rows()
    for name, scene in scenes.items():
        root = output / "sizes" / name
        choice = rightsize(scene, *options, output=root)
        cfg = compose_config([*describe_scene(scene), *options], root)
        data = build_data(cfg)
        assert isinstance(data, RayDataModule)  # scenes, not images
        full = [train_full_run(cfg, rung, choice["sampler"], data, root / f"rung_{i}") for i, rung in enumerate(rungs)]
        chosen_rung = full[choice["rung"]]
        row = {"scene": name, "picture_kB": measure_png_bytes(data.scene.val.images) / 1000, "rung": choice["rung"]}
        row |= {"kB": choice["artifact_bytes"] / 1000, "psnr": chosen_rung.psnr}
        row |= {"below_best": max(full_run.psnr for full_run in full) - chosen_rung.psnr}
        row |= {"share_of_largest": chosen_rung.size / max(full_run.size for full_run in full)}
        row |= {"search_ratio": choice["search_seconds"] / chosen_rung.seconds}
        rows.append({**row, "rungs": " ".join(f"{full_run.psnr:.1f}/{full_run.size / 1000:.0f}" for full_run in full)})
    path = folder / f"{name}_{FEW_VIEWS}.npz"
    assert isinstance(data, RayDataModule)  # of the last scene
    save_npz(replace(data.scene, train=data.scene.train.subsample(FEW_VIEWS)), path)
    sparse = compose_config([*describe_scene(str(path)), *options], output)
    sparse_choice = rightsize(str(path), *options, output=output / "sizes" / path.stem)
    for views, run_cfg, result in ((VIEWS, cfg, choice), (FEW_VIEWS, sparse, sparse_choice)):
        chosen = result["full"][str(result["rung"])]
        default = train_full_run(run_cfg, {}, {}, build_data(run_cfg), output / "sizes" / f"default_{views}")
        row = {"views": views, "rung": result["rung"], "kB": chosen["size"] / 1000, "psnr": chosen["psnr"]}
        sparse_rows.append({**row, "default_kB": default.size / 1000, "default_psnr": default.psnr})
    return name_tables({"sizes": rows, "few": sparse_rows})


def measure_png_bytes(images: Tensor) -> float:
    """Mean PNG size of images [V, H, W, C] in bytes, a measure of complexity."""
    return sum(len(imageio.imwrite("<bytes>", image.numpy(), extension=".png")) for image in images) / len(images)
