"""The search: one training climbs the ladder, growing; the rung that seems enough and a neighbour are trained in full."""

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
from nerf_lightning.runs.compact import encode
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
    choose_neighbour,
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
"""Share of a budget in steps that climbing the whole ladder takes."""
RUNG_STEPS = 300
"""Steps on each rung where the budget is in seconds: what is chosen must not depend on what else the machine does."""
NUM_VIEWS = 8
"""Held-out views that measure a rung, and training views that decide what its file must hold."""
MAX_SAMPLER_LOSS_DB = 0.05
"""By which a sampler may be worse than the best, on the same field."""
WARMUP_GRID_UPDATES = 4
"""After which a sampler knows a field."""
MAX_COMPACT_LOSS_DB = 0.1
PLAN_FILE = "search.json"
"""File that says what is searched for."""


def search_sizes(cfg: DictConfig, target: Target, ladder: Ladder, output: Path) -> dict[str, Any]:
    """Finds the smallest rung that is good enough, and leaves it trained in full in `rung_N`, and compact.npz.

    A search that was interrupted climbs again, to where it did before; what was trained in full is kept.

    Returns:
        The content of rightsize.json: `target`; `growing`, the rungs as they were while growing; `full`, those trained with the
        whole budget, by number; `rung`, the chosen one, with its options of `model` and `sampler`, and the `psnr` and
        `artifact_bytes` of its compact file; whether it `reached` the target; the `device`; and the `search_seconds` of
        training in all.

    Raises:
        InputError: where the device, the data or an option of the ladder is no good; or the folder holds something else.
    """
    device, data = prepare_search(cfg, ladder, output)
    start_or_resume(output, cfg, target, ladder)
    rungs, systems = climb_ladder(cfg, data, ladder.rungs, target, output)
    first = choose_candidate(rungs, target)
    print(f"climbed to rung {len(rungs) - 1}; rung {first} seems enough", flush=True)
    sampler = find_sampler(set_options(cfg, "model", ladder.rungs[first]), data, systems[first], ladder.samplers)
    full = {first: train_full_run(cfg, ladder.rungs[first], sampler, data, output / f"rung_{first}")}
    second = choose_neighbour(first, full[first].psnr, rungs, target, len(ladder.rungs) - 1)
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
        "search_seconds": sum(one.seconds for one in (*rungs, *full.values())),
        "growing": [asdict(one) for one in rungs],
        "full": {str(rung): asdict(one) for rung, one in full.items()},
    }


def prepare_search(cfg: DictConfig, ladder: Ladder, output: Path) -> tuple[torch.device, DataModule]:
    """The device and the data, after all options were checked."""
    device = build.resolve_run_device(cfg)
    silence_lightning()
    prepare_process(cfg)
    data = build.build_data(cfg)
    data.scale_batch(get_limits(cfg, device).batch_scale)
    build.build_system(set_options(cfg, "model", ladder.rungs[0]), build.get_metadata(data), device)
    build.build_trainer(cfg, output, device)
    return device, data


def start_or_resume(output: Path, cfg: DictConfig, target: Target, ladder: Ladder) -> None:
    """Writes down what is searched for, unless the same search began here before.

    Raises:
        InputError: where the folder holds anything else.
    """
    plan = {"target": asdict(target), "ladder": asdict(ladder), "config": config_to_dict(cfg)}
    if is_empty(output):
        write_json(output / PLAN_FILE, plan)
    elif not (output / PLAN_FILE).is_file() or read_json(output / PLAN_FILE, "a plan") != json.loads(json.dumps(plan)):
        hint = "give another --output, or the same options to continue"
        raise InputError(output, "", "holds something else", hint=hint)


def set_options(cfg: DictConfig, group: str, options: Options) -> DictConfig:
    """A copy of a configuration with other options in a group, "" for the top; unknown ones raise when the group is built."""
    changed = copy.deepcopy(cfg)
    for key, value in options.items():
        OmegaConf.update(changed, f"{group}.{key}".lstrip("."), value, force_add=True)
    return changed


def configure_rung(cfg: DictConfig, ladder: Sequence[Options], rung: int) -> DictConfig:
    """The configuration of a rung's training: in steps, however the budget was given, without images, files and curves."""
    steps = build.get_budget_options(cfg).get("steps")
    wanted = RUNG_STEPS if steps is None else max(1, round(steps * LADDER_BUDGET_FRACTION / len(ladder)))
    changed = set_options(cfg, "budget", {"steps": wanted, "seconds": None, "patience": None})
    OmegaConf.update(changed, "callbacks", {"recovery": (cfg.callbacks or {}).get("recovery")}, merge=False)
    OmegaConf.update(changed, "logger", None)
    return set_options(changed, "model", ladder[rung])


def train_rung(cfg: DictConfig, data: DataModule, folder: Path, smaller: System | None = None) -> tuple[System, float]:
    """Trains a system, from what a smaller one has learned if there is room for it.

    Returns:
        The system, on the device that trained it, and the seconds it took.
    """
    prepare_process(cfg)
    silence_lightning()
    data.reset()
    device = build.resolve_run_device(cfg)
    system = build.build_system(cfg, build.get_metadata(data), device)
    if smaller is not None and is_at_least_as_wide(system.field, smaller.field):
        system.warm_start_from(smaller.cpu())  # where a new system is
        smaller.to(device)
    trainer = build.build_trainer(cfg, folder, device)
    warm_up(system, data, device)
    trainer.fit(system, data)
    return system.to(device).eval(), Budget.find(trainer).seconds


def climb_ladder(
    cfg: DictConfig, data: DataModule, ladder: Sequence[Options], target: Target, folder: Path
) -> tuple[list[RungResult], list[System]]:
    """Trains the smallest rung, then continues with each larger one, for as many steps each, while that pays.

    A rung that is smaller than the last in something starts anew.

    Returns:
        The rungs, and their systems.
    """
    rungs: list[RungResult] = []
    systems: list[System] = []
    before = Options()
    for number, options in enumerate(ladder):
        part = configure_rung(cfg, ladder, number)
        model = build.resolve_config(part.model)
        system, seconds = train_rung(
            part, data, folder, systems[-1] if systems and is_larger_model(model, before) else None
        )
        parameters = sum(p.numel() for p in system.parameters() if p.requires_grad)
        rung = RungResult(measure_psnr(system, data), estimate_compact_bytes(part, system, data), parameters, seconds)
        print(f"rung {number}: {format_options(options)}: {format_figures(rung.psnr, rung.size)}", flush=True)
        rungs, systems, before = [*rungs, rung], [*systems, system], model
        if is_growth_finished(rungs, target):
            break
    return rungs, systems


def is_larger_model(model: Options, before: Options) -> bool:
    """Whether no number among a model's options is less than before: only then what that learned fits in."""
    both = ((value, model.get(key)) for key, value in before.items())
    return all(b >= a for a, b in both if isinstance(a, int | float) and isinstance(b, int | float))


def measure_psnr(system: System, data: DataModule) -> float:
    """Mean dB over a few held-out views.

    Raises:
        InputError: where what it shows is not finite.
    """
    found = measure_held_out_psnr(system, data, subsample(data.num_held_out_views, NUM_VIEWS))
    if not math.isfinite(found):
        raise InputError("rightsize", "", "rendered images are not finite", hint="lower optimizer.lr")
    return found


def estimate_compact_bytes(cfg: DictConfig, system: Any, data: DataModule) -> int:
    """Approximate size of a system's compact file: only a few views decide what it must hold."""
    seen = find_seen_cells(system, subsample_cameras(data, NUM_VIEWS)) if data.is_posed else None
    return len(encode(prune_to_cells(system, seen), "byte", config_to_dict(cfg), scene_to_dict(data)))


def find_sampler(cfg: DictConfig, data: DataModule, system: System, samplers: Sequence[Options]) -> Options:
    """The coarsest of some samplers with which a trained field renders as well as with the best; options that its kind of
    sampler does not have are left out."""
    known = inspect.signature(build.resolve_target(cfg, "sampler")).parameters if samplers else {}
    scores: list[tuple[Options, float]] = []
    for options in (one for one in samplers if one.keys() <= known.keys()):
        probe: Any = build.build_system(set_options(cfg, "sampler", options), build.get_metadata(data), system.device)
        probe.field = system.field
        probe.to(system.device)
        probe.sampler.mark_invisible_cells(data.scene.train.cameras)
        for number in range(WARMUP_GRID_UPDATES):
            step = number * getattr(probe.sampler, "update_every", 1)
            generator = step_generator(probe.seed, Stream.ANALYSIS, number, probe.device)
            probe.sampler.update(step, probe.field.density, generator)
        scores.append((options, measure_psnr(probe.eval(), data)))
    enough = max((psnr for _, psnr in scores), default=0.0) - MAX_SAMPLER_LOSS_DB
    return next((options for options, psnr in scores if psnr >= enough), {})


def train_full_run(cfg: DictConfig, model: Options, sampler: Options, data: DataModule, folder: Path) -> RungResult:
    """Trains a run of its own, with the whole budget. One that is finished is kept, one that was interrupted continues."""
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
    """dB and bytes in words."""
    return f"{psnr:.2f} dB in {size / 1000:,.1f} kB"
