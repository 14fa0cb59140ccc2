"""The whole search: climb, choose, confirm, and write down why."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from nerf_lightning.config.build import build_data, build_system, build_trainer, corrects_poses, device_of, frame_of
from nerf_lightning.config.limits import limits_of
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.dataset.plausible import check_scene
from nerf_lightning.export.smallest import Compact, smallest
from nerf_lightning.rightsize.choose import (
    Measured,
    Target,
    best_of,
    candidate,
    chosen,
    climbed_enough,
    expected,
    next_to_train,
)
from nerf_lightning.rightsize.climb import Rung, climb, coarsest_sampler, compact_bytes, set_options, spread
from nerf_lightning.rightsize.ladder import Ladder, Options
from nerf_lightning.rightsize.start import begin
from nerf_lightning.runs.folder import load_run, plain_config
from nerf_lightning.runs.index import read_run
from nerf_lightning.training.before import left_of
from nerf_lightning.training.train import prepare, train
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.libraries import silence_lightning

MOST_FULL = 2
"""Trainings in full: the candidate, and the one it is compared with."""
COMPACT_LOSS = 0.1
"""dB that the compact file may lose."""


@dataclass(frozen=True)
class Full(Measured):
    """A rung trained with the whole budget, measured on all held-out views."""

    folder: Path
    seconds: float
    """Of training."""
    parameters: int


@dataclass(frozen=True)
class Found:
    """The result of a search."""

    target: Target
    ladder: Ladder
    rungs: Sequence[Rung]
    full: dict[int, Full]
    """By rung."""
    choice: int
    reached: bool
    reason: str
    noise: float
    sampler: Options
    seconds: float
    """Of training, climbing and all."""
    wall_seconds: float
    compact: Compact
    device: torch.device
    """Where all of it was computed."""


def search(cfg: DictConfig, target: Target, ladder: Ladder, output: Path) -> Found:
    """Finds the smallest rung that is good enough, and leaves it trained in full, with its compact file.

    A search that was interrupted climbs again, for as long and to where it did before; what was trained in full
    is not trained again.

    Raises:
        InputError: where the device is not there, or the data, or an option of the ladder, is no good; or the folder holds
            something else.
    """
    began = time.perf_counter()
    device = device_of(cfg)
    silence_lightning()
    prepare(cfg)
    data = build_data(cfg)
    data.enlarge(limits_of(cfg, device).batch)
    build_system(set_options(cfg, "model", ladder.rungs[0]), frame_of(data), device)
    build_trainer(cfg, output, device)  # what is wrong with an option is told before anything is written
    begin(output, cfg, target, ladder)
    for doubt in check_scene(data.scene, corrects_poses(cfg)) if isinstance(data, RayDataModule) else []:
        print(f"{data.scene.name}: {doubt.text}", flush=True)
    rungs: list[Rung] = []
    noise = seconds = 0.0
    why = "the ladder ends there"
    for rung in climb(cfg, data, ladder.rungs, output):
        rungs.append(rung)
        seconds += rung.seconds
        print(f"rung {len(rungs) - 1}: {told(rung.options)}: {figures(rung.psnr, rung.size)}", flush=True)
        if len(rungs) == 1:
            noise, spent = spread(cfg, data, ladder.rungs, rung, output)
            seconds += spent
            print(f"seeds differ by {noise:.2f} dB", flush=True)
        stop = climbed_enough(rungs, target, noise)
        if stop:
            why = stop
            break
    first, best = candidate(rungs, target), best_of(rungs)
    print(f"climbed to rung {len(rungs) - 1}: {why}; rung {first} seems enough", flush=True)
    model = set_options(cfg, "model", rungs[first].options)
    sampler = coarsest_sampler(model, data, rungs[first].system, ladder.samplers)
    full: dict[int, Full] = {}
    while True:
        tried = {index: one.psnr for index, one in full.items()}
        following = next_to_train(tried, rungs, target, len(ladder.rungs) - 1, MOST_FULL)
        if following is None:
            break
        print(f"rung {following} in full", flush=True)
        full[following] = train_in_full(cfg, ladder.rungs[following], sampler, data, output / f"rung_{following}")
        seconds += full[following].seconds
    tried = {index: one.psnr for index, one in full.items()}
    found = chosen(tried, best, target)
    choice = found if found is not None else max(tried, key=lambda index: tried[index])
    run = load_run(full[choice].folder, device=device)
    compact = smallest(run.system, data, plain_config(run.cfg), COMPACT_LOSS)
    with atomic(output / "compact.npz") as temporary:
        temporary.write_bytes(compact.content)
    reason = in_words(target, tried, choice, found is not None, why, noise)
    if target.psnr is not None and 0 < choice < len(rungs) and choice - 1 not in tried:
        reason += f"; rung {choice - 1} would be expected at {expected(choice - 1, tried, rungs):.1f} dB"
    wall = time.perf_counter() - began
    return Found(
        target, ladder, rungs, full, choice, found is not None, reason, noise, sampler, seconds, wall, compact, device
    )


def train_in_full(cfg: DictConfig, model: Options, sampler: Options, data: Any, folder: Path) -> Full:
    """A run of its own, with the whole budget, as if nothing else ran beside it. One that is there is not trained again, one
    that was interrupted goes on."""
    whole = set_options(set_options(cfg, "model", model), "sampler", sampler)
    whole = set_options(whole, "budget", {"alone": True})
    done, checkpoint = left_of(read_run(folder), whole)
    if done is None:
        train(whole, checkpoint, folder)
    results = read_run(folder).results
    run = load_run(folder, device=device_of(cfg))
    size = compact_bytes(run.cfg, run.system, data)
    return Full(results["psnr"], size, folder, results["train_seconds"], results["parameters"])


def told(options: Options) -> str:
    """Options in one line."""
    return ", ".join(f"{key}={value}" for key, value in options.items())


def figures(psnr: float, size: int) -> str:
    """A rung's figures in one line."""
    return f"{psnr:.2f} dB in {size / 1000:,.1f} kB"


def in_words(target: Target, tried: dict[int, float], choice: int, reached: bool, why: str, noise: float) -> str:
    """Why this rung."""
    mine = f"rung {choice} reaches {tried[choice]:.2f} dB trained in full"
    others = {index: psnr for index, psnr in tried.items() if index != choice}
    if target.psnr is not None:
        if not reached:
            return f"{mine}, the most of those tried: the target of {target.psnr:g} dB was not reached"
        smaller = [f"rung {index} only {psnr:.2f} dB" for index, psnr in others.items() if index < choice]
        return "; ".join(
            [f"{mine}, the target is {target.psnr:g} dB", *smaller, *(["it is the smallest"] if not choice else [])]
        )
    largest = [
        f"rung {index}, the best while growing, {psnr:.2f} dB" for index, psnr in others.items() if index > choice
    ]
    smaller = [f"rung {index} only {psnr:.2f} dB" for index, psnr in others.items() if index < choice]
    held = "; ".join([*largest, *smaller]) or "no larger one was better while growing"
    return f"{mine}; {held}; {target.within_db:g} dB below the best are allowed, and seeds differ by {noise:.2f} dB ({why})"
