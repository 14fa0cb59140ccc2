"""Size search: one growing training climbs the ladder; the candidate rung and a neighbor are trained in full."""

import copy
import inspect
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.callbacks import Budget
from nerf_lightning.config import build
from nerf_lightning.config.limits import get_limits
from nerf_lightning.dataset import DataModule
from nerf_lightning.errors import InputError
from nerf_lightning.export.compress import (
    compress_system,
    find_seen_cells,
    measure_held_out_psnr,
    prune_to_cells,
    subsample_cameras,
)
from nerf_lightning.model import is_at_least_as_wide
from nerf_lightning.runs.compact import encode_system
from nerf_lightning.runs.folder import config_to_dict, load_run
from nerf_lightning.runs.run_lock import is_empty
from nerf_lightning.runs.scene_file import scene_to_dict
from nerf_lightning.runs.summaries import read_run
from nerf_lightning.sizing.choose import (
    Ladder,
    Options,
    RungResult,
    Target,
    choose_candidate,
    choose_final,
    choose_neighbor,
    is_growth_finished,
)
from nerf_lightning.system import System
from nerf_lightning.training.job import find_progress
from nerf_lightning.training.process import prepare_process, warm_up
from nerf_lightning.training.train import train
from nerf_lightning.utils.files import atomic_write, write_json
from nerf_lightning.utils.libraries import silence_lightning
from nerf_lightning.utils.parsing import read_json
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.text import subsample

LADDER_BUDGET_FRACTION = 0.75
"""Fraction of a step budget for climbing the whole ladder."""
RUNG_STEPS = 300
"""Steps per rung for budgets in seconds: the choice must not depend on background load."""
NUM_VIEWS = 8
"""Held-out views that measure a rung, and training views that prune its file."""
MAX_SAMPLER_LOSS_DB = 0.05
"""PSNR that a coarser sampler may lose on the same field."""
WARMUP_GRID_UPDATES = 4
"""Updates after which an occupancy grid has converged on a trained field."""
MAX_COMPACT_LOSS_DB = 0.1
PLAN_FILE = "search.json"
"""The search's target, ladder and configuration."""


def search_sizes(cfg: DictConfig, target: Target, ladder: Ladder, output: Path) -> dict[str, Any]:
    """Finds the smallest rung that is good enough; writes its run to `rung_N`, and compact.npz.

    An interrupted search climbs again, with the same results; full trainings are kept.

    Returns:
        The content of rightsize.json: `target`; `growing`, the rungs while growing; `full`, those trained with the whole
        budget, by index; `rung`, the chosen one, with its `model` and `sampler` options, and `psnr` and `artifact_bytes` of
        its compact file; whether it `reached` the target; `device`; and `search_seconds`, the total training time.

    Raises:
        InputError: invalid device, data or ladder options; or the folder holds something else.
    """
    device, data = prepare_search(cfg, ladder, output)
    write_or_check_plan(output, cfg, target, ladder)
    rungs, systems = climb_ladder(cfg, data, ladder.rungs, target, output)
    first = choose_candidate(rungs, target)
    print(f"climbed to rung {len(rungs) - 1}; training rung {first} in full", flush=True)
    sampler = find_sampler(set_options(cfg, "model", ladder.rungs[first]), data, systems[first], ladder.samplers)
    full = {first: train_full_run(cfg, ladder.rungs[first], sampler, data, output / f"rung_{first}")}
    second = choose_neighbor(first, full[first].psnr, rungs, target, len(ladder.rungs) - 1)
    if second is not None:
        full[second] = train_full_run(cfg, ladder.rungs[second], sampler, data, output / f"rung_{second}")
    choice, reached = choose_final(full, target)
    run = load_run(output / f"rung_{choice}", device=device)
    compact = compress_system(run.system, data, config_to_dict(run.cfg), MAX_COMPACT_LOSS_DB)
    with atomic_write(output / "compact.npz") as temporary:
        temporary.write_bytes(compact.content)
    return {
        "target": asdict(target),
        "reached": reached,
        "device": str(device),
        "rung": choice,
        "model": ladder.rungs[choice],
        "sampler": sampler,
        "psnr": compact.psnr,
        "artifact_bytes": len(compact.content),
        "search_seconds": sum(result.seconds for result in (*rungs, *full.values())),
        "growing": [asdict(result) for result in rungs],
        "full": {str(rung): asdict(result) for rung, result in full.items()},
    }


def prepare_search(cfg: DictConfig, ladder: Ladder, output: Path) -> tuple[torch.device, DataModule]:
    """Checks all options; returns the device and the data."""
    device = build.resolve_run_device(cfg)
    silence_lightning()
    prepare_process(cfg)
    data = build.build_data(cfg)
    data.scale_batch(get_limits(cfg, device).batch_scale)
    build.build_system(set_options(cfg, "model", ladder.rungs[0]), build.get_metadata(data), device)
    build.build_trainer(cfg, output, device)
    return device, data


def write_or_check_plan(output: Path, cfg: DictConfig, target: Target, ladder: Ladder) -> None:
    """Writes the search plan, unless the folder holds the same one.

    Raises:
        InputError: the folder holds anything else.
    """
    plan = {"target": asdict(target), "ladder": asdict(ladder), "config": config_to_dict(cfg)}
    if is_empty(output):
        write_json(output / PLAN_FILE, plan)
    elif not (output / PLAN_FILE).is_file() or read_json(output / PLAN_FILE, "a plan") != json.loads(json.dumps(plan)):
        hint = "give another --output, or the same options to continue"
        raise InputError(output, "", "holds something else", hint=hint)


def set_options(cfg: DictConfig, group: str, options: Options) -> DictConfig:
    """A copy of a configuration with options of a group replaced ("" for the top level), not yet validated."""
    changed = copy.deepcopy(cfg)
    for key, value in options.items():
        OmegaConf.update(changed, f"{group}.{key}".lstrip("."), value, force_add=True)
    return changed


def configure_rung(cfg: DictConfig, ladder: Sequence[Options], rung: int) -> DictConfig:
    """The configuration of a rung's training: a step budget, no logger, and no callbacks but recovery."""
    steps = build.get_budget_options(cfg).get("steps")
    rung_steps = RUNG_STEPS if steps is None else max(1, round(steps * LADDER_BUDGET_FRACTION / len(ladder)))
    changed = set_options(cfg, "budget", {"steps": rung_steps, "seconds": None, "patience": None})
    OmegaConf.update(changed, "callbacks", {"recovery": (cfg.callbacks or {}).get("recovery")}, merge=False)
    OmegaConf.update(changed, "logger", None)
    return set_options(changed, "model", ladder[rung])


def train_rung(cfg: DictConfig, data: DataModule, folder: Path, smaller: System | None = None) -> tuple[System, float]:
    """Trains a system, warm-started from a smaller one if that fits.

    Returns:
        The system, on its training device, and the training time in seconds.
    """
    prepare_process(cfg)
    silence_lightning()
    data.reset()
    device = build.resolve_run_device(cfg)
    system = build.build_system(cfg, build.get_metadata(data), device)
    if smaller is not None and is_at_least_as_wide(system.field, smaller.field):
        system.warm_start_from(smaller.cpu())  # a new system is on the CPU
        smaller.to(device)
    trainer = build.build_trainer(cfg, folder, device)
    warm_up(system, data, device)
    trainer.fit(system, data)
    return system.to(device).eval(), Budget.find(trainer).seconds


def climb_ladder(
    cfg: DictConfig, data: DataModule, ladder: Sequence[Options], target: Target, folder: Path
) -> tuple[list[RungResult], list[System]]:
    """Trains rungs in ascending order, each warm-started from the last, until `is_growth_finished`.

    A rung that is smaller than the last in any option starts from scratch.

    Returns:
        The results, and their systems.
    """
    rungs: list[RungResult] = []
    systems: list[System] = []
    previous = Options()
    for number, options in enumerate(ladder):
        part = configure_rung(cfg, ladder, number)
        model = build.resolve_config(part.model)
        smaller = systems[-1] if systems and is_larger_model(model, previous) else None
        system, seconds = train_rung(part, data, folder, smaller)
        parameters = sum(p.numel() for p in system.parameters() if p.requires_grad)
        rung = RungResult(measure_psnr(system, data), estimate_compact_bytes(part, system, data), parameters, seconds)
        print(f"rung {number}: {format_options(options)}: {format_figures(rung.psnr, rung.size)}", flush=True)
        rungs, systems, previous = [*rungs, rung], [*systems, system], model
        if is_growth_finished(rungs, target):
            break
    return rungs, systems


def is_larger_model(model: Options, previous: Options) -> bool:
    """Whether no numeric option decreases, so that the previous weights fit."""
    both = ((value, model.get(key)) for key, value in previous.items())
    return all(b >= a for a, b in both if isinstance(a, int | float) and isinstance(b, int | float))


def measure_psnr(system: System, data: DataModule) -> float:
    """Mean PSNR over `NUM_VIEWS` held-out views, dB.

    Raises:
        InputError: rendered images are not finite.
    """
    psnr = measure_held_out_psnr(system, data, subsample(data.num_held_out_views, NUM_VIEWS))
    if not math.isfinite(psnr):
        raise InputError("rightsize", "", "rendered images are not finite", hint="lower optimizer.lr")
    return psnr


def estimate_compact_bytes(cfg: DictConfig, system: Any, data: DataModule) -> int:
    """Approximate size of a system's compact file, pruned by `NUM_VIEWS` views."""
    seen = find_seen_cells(system, subsample_cameras(data, NUM_VIEWS)) if data.is_posed else None
    return len(encode_system(prune_to_cells(system, seen), "byte", config_to_dict(cfg), scene_to_dict(data)))


def find_sampler(cfg: DictConfig, data: DataModule, system: System, samplers: Sequence[Options]) -> Options:
    """The coarsest sampler options that render a trained field as well as the best; skips options of other samplers."""
    known = inspect.signature(build.resolve_target(cfg, "sampler")).parameters if samplers else {}
    scores: list[tuple[Options, float]] = []
    for options in (entry for entry in samplers if entry.keys() <= known.keys()):
        probe: Any = build.build_system(set_options(cfg, "sampler", options), build.get_metadata(data), system.device)
        probe.field = system.field
        probe.to(system.device)
        probe.sampler.mark_invisible_cells(data.scene.train.cameras)
        for number in range(WARMUP_GRID_UPDATES):
            step = number * getattr(probe.sampler, "update_every", 1)
            generator = step_generator(probe.seed, Stream.ANALYSIS, number, probe.device)
            probe.sampler.update(step, probe.field.density, generator)
        scores.append((options, measure_psnr(probe.eval(), data)))
    threshold = max((psnr for _, psnr in scores), default=0.0) - MAX_SAMPLER_LOSS_DB
    return next((options for options, psnr in scores if psnr >= threshold), {})


def train_full_run(cfg: DictConfig, model: Options, sampler: Options, data: DataModule, folder: Path) -> RungResult:
    """Trains a rung with the whole budget; keeps a finished run, continues an interrupted one."""
    whole = set_options(set_options(cfg, "model", model), "sampler", sampler)
    print(f"{folder}: {format_options(model)}, in full", flush=True)
    done, checkpoint = find_progress(read_run(folder), whole)
    if done is None:
        train(whole, checkpoint, folder)
    results, run = read_run(folder).results, load_run(folder, device=build.resolve_run_device(cfg))
    size = estimate_compact_bytes(run.cfg, run.system, data)
    return RungResult(results["psnr"], size, results["parameters"], results["train_seconds"])


def format_options(options: Options) -> str:
    return ", ".join(f"{key}={value}" for key, value in options.items())


def format_figures(psnr: float, size: int) -> str:
    return f"{psnr:.2f} dB in {size / 1000:,.1f} kB"
