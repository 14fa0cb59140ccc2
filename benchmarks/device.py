"""A device in one command of at most 8 minutes: GPU kernels, a step of each recipe, held-out PSNR over time, views, memory.

Stages run on after one that fails, and each is written to the JSON file as it ends. Trainings are processes of their own.
"""

import argparse
import gc
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch

import nerf_lightning as nl
from benchmarks.agreement import describe_failure
from benchmarks.methods import train
from benchmarks.step_time import TIMED_PERIODS, WARMUP_STEPS, measure_steps, profile_step, start_training
from benchmarks.tables import Row, Rows, format_cell, name_tables
from nerf_lightning.dataset import save_npz
from nerf_lightning.kernels.gpu import self_test
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.synthetic.rooms import ROOMS, make_room_scene
from nerf_lightning.utils.machine import accelerator_name, processor_name

RECIPES = ("tensorf_medium", "hashgrid_medium", "hashgrid_capture")
GPU_RECIPES = ("tensorf_gpu", "hashgrid_gpu", "hashgrid_capture_gpu")
OBJECT, CAPTURE = "lego", "capture"
"""Experiments of bounded and of unbounded scenes; the latter's recipes have the word in their name."""
MAX_SECONDS, RUN_SECONDS = 480, 15
"""Most time of all stages, and an estimate of a training's besides its budget: start, compilation, evaluation."""


@dataclass(frozen=True)
class Extent:
    """How much is measured: built-in scenes' pixels along a side and views, seconds of trainings, steps, overrides."""

    size: int = 800
    capture_size: int = 240
    views: int = 60
    seconds: tuple[float, ...] = (5, 15, 60)
    capture_seconds: tuple[float, ...] = (10, 60)
    warmup_steps: int = WARMUP_STEPS
    timed_periods: int = TIMED_PERIODS
    overrides: tuple[str, ...] = ()


QUICK = Extent(24, 24, 10, (0.2,), (0.2,), 1, 1, ("dataset.samples=512", "dataset.rays=64"))


def prepare_scenes(paths: list[Path], folder: Path, extent: Extent) -> dict[str, Path]:
    """Returns the scene of each experiment: a given one, or else a built-in one, written to a file."""
    scenes = {CAPTURE if nl.load_scene(path).bounds.unbounded else OBJECT: path for path in paths}
    room = partial(make_room_scene, ROOMS["filling subject"], 0)
    built_in = (OBJECT, "bricks", bricks, extent.size), (CAPTURE, "room", room, extent.capture_size)
    for experiment, name, build, size in built_in:
        if experiment not in scenes:
            print(f"device: rendering the {name}", flush=True)
            scenes[experiment] = folder / f"{name}.npz"
            save_npz(build(size, extent.views, max(2, extent.views // 10)), scenes[experiment])
    return scenes


def check_kernels(device: torch.device) -> Rows:
    """Compares each kernel for GPUs with the reference on the device."""
    if device.type != "cuda":
        return [{"kernel": f"none for {device.type}: they need an NVIDIA GPU"}]
    if obstacle := self_test.find_obstacle(device):
        return [{"kernel": "all", "differs": obstacle}]
    rows = []
    for name, difference in self_test.measure_differences(device):
        is_equal = not isinstance(difference, str) and difference <= self_test.TOLERANCE
        rows.append({"kernel": name, "difference": difference, "differs": "" if is_equal else str(difference)})
    return rows


def measure_recipe(options: list[str], device: torch.device, recipe: str, extent: Extent) -> Rows:
    """Measures and profiles a step of a recipe."""
    training = start_training(options, device, extent.warmup_steps)
    steps = [measure_steps(training, extent.timed_periods)]
    return name_tables({"steps": steps, f"profile of {recipe}": profile_step(training)})


def train_recipe(experiment: str, options: list[str], recipe: str, seconds: float, folder: Path) -> Rows:
    """Trains a recipe for some seconds, as a user would."""
    run = train(experiment, [*options, f"budget.seconds={seconds}"], 0, folder / f"{recipe}_{seconds:g}s")
    width, height = run["scene"]["resolution"]
    figures = {key: run[key] for key in ("psnr", "ssim", "steps", "render_seconds_per_view", "peak_memory_bytes")}
    scene, ms = f"{run['scene']['name']}, {width}x{height}", 1e3 * run["train_seconds"] / run["steps"]
    return [{"scene": scene, **figures, "ms_per_step": ms}]


def list_stages(args: argparse.Namespace, extent: Extent) -> Iterator[tuple[Row, float, Callable[[], Rows]]]:
    """Yields the labels, estimated seconds and function of each stage."""
    yield {"table": "kernels"}, 0, partial(check_kernels, args.device)
    folder = args.output / "device"
    folder.mkdir(exist_ok=True)
    scenes = prepare_scenes(args.scenes, folder, extent)
    recipes = args.recipes or (GPU_RECIPES if args.device.type == "cuda" else RECIPES)
    experiments = {recipe: CAPTURE if CAPTURE in recipe else OBJECT for recipe in recipes}
    options = {
        recipe: [f"dataset.path='{scenes[experiments[recipe]].resolve()}'", "dataset.resize=null", f"recipe={recipe}"]
        + [f"device={args.device.type}", "overwrite=true", *extent.overrides, *args.overrides]
        for recipe in recipes
    }
    for recipe, given in options.items():
        stage = partial(measure_recipe, [f"+experiment={experiments[recipe]}", *given], args.device, recipe, extent)
        yield {"table": "steps", "recipe": recipe}, RUN_SECONDS, stage
    budgets = {name: extent.capture_seconds if CAPTURE in name else extent.seconds for name in recipes}
    for seconds, recipe in sorted((seconds, name) for name, budget in budgets.items() for seconds in budget):
        stage = partial(train_recipe, experiments[recipe], options[recipe], recipe, seconds, folder)
        yield {"table": "trainings", "recipe": recipe, "seconds": seconds}, seconds + RUN_SECONDS, stage


def format_markdown(rows: Rows, device: torch.device) -> Rows:
    """One line per recipe for a Markdown table of devices."""
    lines = []
    for recipe in dict.fromkeys(row["recipe"] for row in rows if "psnr" in row):
        runs = [row for row in rows if "psnr" in row and row["recipe"] == recipe]
        step_ms = next((row["step_ms"] for row in rows if "step_ms" in row and row["recipe"] == recipe), None)
        seconds = " / ".join(f"{run['seconds']:g}" for run in runs)
        quality = " / ".join(f"{run['psnr']:.2f}" for run in runs)
        view, memory = runs[-1]["render_seconds_per_view"], runs[-1]["peak_memory_bytes"] / 1e9
        cells = [accelerator_name(device) or processor_name(), runs[0]["scene"], f"`recipe={recipe}`", f"{seconds} s"]
        cells += [f"{quality} dB", f"{format_cell(step_ms)} ms", f"{view:.3g} s", f"{memory:.2g} GB"]
        lines.append({"table": "Markdown", "line": f"| {' | '.join(cells)} |"})
    return lines


def measure(args: argparse.Namespace) -> Iterable[Row]:
    """Yields the rows of all stages, each as soon as it is measured."""
    extent, start, rows = QUICK if args.quick else Extent(), time.perf_counter(), []
    for labels, seconds, stage in list_stages(args, extent):
        now = time.perf_counter() - start
        print(f"device: {', '.join(map(str, labels.values()))}, after {now:.0f} s", flush=True)
        try:
            if now + seconds > MAX_SECONDS:
                raise TimeoutError(f"skipped, as it would end after {MAX_SECONDS} s")
            measured = stage()
        except (Exception, SystemExit) as error:
            logging.warning("%s", labels, exc_info=True)
            measured = [{"differs": describe_failure(error)}]
        gc.collect()
        if args.device.type == "cuda":
            torch.cuda.empty_cache()  # for the processes of trainings
        rows += (labeled := [{**labels, **row} for row in measured])
        yield from labeled
    yield from format_markdown(rows, args.device)
