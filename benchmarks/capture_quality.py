"""Photos with a background: PSNR of each method; in synthetic rooms, whose depth is known, also depth error and floaters."""

import argparse
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

import nerf_lightning as nl
from benchmarks.methods import train
from benchmarks.synthetic.foliage import write_foliage
from benchmarks.synthetic.rooms import render_true_view, write_room
from benchmarks.tables import Rows, compute_medians
from nerf_lightning.cameras import Rays
from nerf_lightning.dataset import Scene
from nerf_lightning.synthetic.rooms import ROOMS, Room
from nerf_lightning.system import NeRF3D

RECIPES = ("hashgrid_capture", "tensorf_medium", "voxels_medium")
FREE_SPACE_FRACTION = 0.95
"""Density nearer than this fraction of the true distance counts as floaters."""
MAX_VIEWS, PIXELS_PER_VIEW = 4, 6000
"""Most held-out views compared with the truth, and pixels of each."""


def measure_fog(system: NeRF3D, rays: Rays, distance: Float[Tensor, "R"]) -> Float[Tensor, "R"]:
    """Opacity of each ray up to a distance."""
    with torch.no_grad():
        samples = system.sampler(rays, system.field.density)
        density = system.field.density(samples.positions(rays))
    length = distance[samples.ray] - (samples.t - samples.dt / 2)
    optical_depth = density * torch.minimum(length.clamp_min(0), samples.dt)
    return 1 - torch.exp(-torch.zeros(len(rays)).index_add(0, samples.ray, optical_depth))


def compare_with_truth(run: nl.Run, scene: Scene, room: Room) -> dict[str, float]:
    """Subject's PSNR; median depth error, the same of the floor, and mean opacity in free space, percent."""
    errors, floors, fog, squares = [], [], [], []
    for view in range(min(len(scene.val), MAX_VIEWS)):
        camera = scene.val.cameras[view]
        rays, (distance, body) = camera.generate_view_rays(0), render_true_view(room, scene, view)
        pixels = torch.arange(0, len(rays), max(1, len(rays) // PIXELS_PER_VIEW))
        sampled, true_depth = rays[pixels], distance[pixels]
        error = (run.system.render(sampled).depth - true_depth).abs() / true_depth
        errors.append(error)
        floors.append(error[body[pixels] == len(room.primitives) - 2])
        fog.append(measure_fog(run.system, sampled, FREE_SPACE_FRACTION * true_depth))
        rendered, truth = run.render(camera).rgb.view(-1, 3), scene.val.image(view).view(-1, 3) / 255
        squares.append((rendered - truth)[body < room.num_subject_primitives] ** 2)
    return {
        "subject_db": -10 * float(torch.cat(squares).mean().log10()),
        "depth_percent": 100 * float(torch.cat(errors).median()),
        "floor_percent": 100 * float(torch.cat(floors).median()),
        "fog_percent": 100 * float(torch.cat(fog).mean()),
    }


def measure(args: argparse.Namespace) -> Rows:
    """Measures each scene and recipe; rows are medians over seeds."""
    overrides, budget, output = args.overrides, args.budgets[0], args.output
    folders: dict[str, tuple[Path, Room | None]] = {path.name: (path, None) for path in args.scenes}
    for name, synthetic_room in ROOMS.items():
        folder = output / "rooms" / name.replace(" ", "_")
        if not folder.exists():
            write_room(synthetic_room, folder)
        folders[name] = folder, synthetic_room
    folders["foliage"] = write_foliage(output / "foliage"), None
    rows: Rows = []
    for name, (path, room) in folders.items():
        for recipe in args.recipes or RECIPES:
            runs = []
            for seed in args.seeds:
                print(f"capture_quality: {name}, {recipe}, seed {seed}", flush=True)
                run_folder = output / "captures" / f"{name}_{recipe}_{seed}".replace(" ", "_")
                options = [f"dataset.path='{path}'", f"recipe={recipe}", f"budget.seconds={budget}", *overrides]
                figures = train("capture", options, seed, run_folder)
                row = {key: figures[key] for key in ("psnr", "ssim", "psnr_worst_view", "render_seconds_per_view")}
                row["peak_memory_bytes"] = figures["peak_memory_bytes"]
                if room is not None:
                    row |= compare_with_truth(nl.load_run(run_folder, "cpu"), nl.load_scene(path), room)
                runs.append(row)
            rows.append({"capture": name, "recipe": recipe, **compute_medians(runs)})
    return rows
