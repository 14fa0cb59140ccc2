"""Climbing a ladder: one training that starts small and grows, keeping what was learned."""

import copy
import inspect
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import stdev
from typing import Any

from omegaconf import DictConfig, OmegaConf

from nerf_lightning.callbacks import Budget
from nerf_lightning.config.build import (
    budget_options,
    build_system,
    build_trainer,
    device_of,
    frame_of,
    resolved,
    target_of,
)
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.errors import InputError
from nerf_lightning.export.reach import confined_to, seen_cells
from nerf_lightning.export.smallest import held_out_psnr, some_cameras
from nerf_lightning.model import as_wide
from nerf_lightning.rightsize.choose import Measured
from nerf_lightning.rightsize.ladder import Options
from nerf_lightning.runs.compact import encode
from nerf_lightning.runs.folder import plain_config
from nerf_lightning.runs.scene_file import scene_content
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.training.room import check_room
from nerf_lightning.training.train import prepare, warm_up
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.text import subsample

Data = RayDataModule | PixelDataModule
SEARCH = 0.75
"""Share of a budget in steps that climbing the whole ladder takes."""
RUNG_STEPS = 300
"""Steps on each rung where the budget is in seconds: what is chosen must not depend on what else the machine does."""
VIEWS = 8
"""Held-out views that measure a rung, and training views that decide what its file must hold."""
EXTRA_SEEDS = 2
"""Further trainings of the smallest rung, to measure the spread over seeds."""
AS_GOOD = 0.05
"""dB by which a sampler may be worse than the best, on the same field."""
LOOKS = 4
"""Updates after which a sampler knows a field."""
BARE = ("guard",)
"""Callbacks of a rung's training."""


@dataclass(frozen=True)
class Rung(Measured):
    """A rung that was climbed to."""

    options: Options
    system: System
    parameters: int
    seconds: float
    """Of training on this rung."""


def set_options(cfg: DictConfig, group: str, options: Options) -> DictConfig:
    """A copy of a configuration with other options in a group; unknown ones raise when the group is built."""
    changed = copy.deepcopy(cfg)
    for key, value in options.items():
        OmegaConf.update(changed, f"{group}.{key}", value, force_add=True)
    return changed


def for_a_rung(cfg: DictConfig, rungs: int) -> DictConfig:
    """A configuration for training one of several rungs: in steps, however the budget was given."""
    steps = budget_options(cfg).get("steps")
    wanted = RUNG_STEPS if steps is None else max(1, round(steps * SEARCH / rungs))
    return bare(set_options(cfg, "budget", {"steps": wanted, "seconds": None, "patience": None}))


def bare(cfg: DictConfig) -> DictConfig:
    """A configuration without what makes pictures, files and curves."""
    changed = copy.deepcopy(cfg)
    kept: dict[str, Any] = {name: node for name, node in resolved(cfg.callbacks).items() if name in BARE}
    OmegaConf.update(changed, "callbacks", kept, merge=False)
    OmegaConf.update(changed, "logger", None)
    return changed


def trained(cfg: DictConfig, data: Data, folder: Path, start: System | None = None) -> tuple[System, float]:
    """Trains a system, from what a smaller one has learned if there is room for it.

    Returns:
        The system, on the device that trained it, and the seconds it took.
    """
    prepare(cfg)
    if isinstance(data, RayDataModule):
        data.start_again()
    device = device_of(cfg)
    system = build_system(cfg, frame_of(data), device)
    check_room(system, data, device)
    if start is not None and as_wide(system.field, start.field):
        system.warm_start_from(start.cpu())  # where a new system is
        start.to(device)
    trainer = build_trainer(cfg, folder, device)
    warm_up(system, data, device)
    trainer.fit(system, data)
    return system.to(device).eval(), Budget.of(trainer).seconds


def quality(system: System, data: Data) -> float:
    """Mean dB over a few held-out views.

    Raises:
        InputError: where what it shows is not finite.
    """
    found = held_out_psnr(system, data, subsample(data.held_out_views, VIEWS))
    if not math.isfinite(found):
        raise InputError("rightsize", "", "pictures that are not finite", "a field that learns", "lower optimizer.lr")
    return found


def compact_bytes(cfg: DictConfig, system: System, data: Data) -> int:
    """Approximate size of a system's compact file: only a few views decide what it must hold."""
    seen = seen_cells(system, some_cameras(data, VIEWS)) if isinstance(data, RayDataModule) else None
    part = confined_to(system, seen)
    return len(encode(part, "byte", plain_config(cfg), scene_content(data)))


def climb(cfg: DictConfig, data: Data, rungs: list[Options], folder: Path) -> Iterator[Rung]:
    """Trains the smallest rung, then goes on with each next larger one, for as many steps each.

    A rung that is smaller than the last in something starts anew.
    """
    start: System | None = None
    part, before = for_a_rung(cfg, len(rungs)), Options()
    for options in rungs:
        with_options = set_options(part, "model", options)
        model = resolved(with_options.model)
        system, seconds = trained(with_options, data, folder, start if grows(before, model) else None)
        parameters = sum(p.numel() for p in system.parameters() if p.requires_grad)
        psnr, size = quality(system, data), compact_bytes(with_options, system, data)
        yield Rung(psnr, size, options, system, parameters, seconds)
        start, before = system, model


def grows(before: Options, after: Options) -> bool:
    """Whether no number among a model's options is less than in those before: only then there is room for what that learned."""
    both = ((value, after.get(key)) for key, value in before.items())
    return all(b >= a for a, b in both if isinstance(a, int | float) and isinstance(b, int | float))


def spread(cfg: DictConfig, data: Data, rungs: list[Options], first: Rung, folder: Path) -> tuple[float, float]:
    """The standard deviation of the smallest rung's PSNR over a few seeds, dB.

    Returns:
        It, and the seconds of training it took.
    """
    part = set_options(for_a_rung(cfg, len(rungs)), "model", first.options)
    found, spent = [first.psnr], 0.0
    for extra in range(1, EXTRA_SEEDS + 1):
        another = copy.deepcopy(part)
        another.seed = cfg.seed + extra
        system, seconds = trained(another, data, folder)
        found.append(quality(system, data))
        spent += seconds
    return stdev(found), spent


def settle(system: NeRF3D) -> None:
    """Lets a new sampler find out where the field is dense."""
    for look in range(LOOKS):
        step = look * getattr(system.sampler, "update_every", 1)
        system.sampler.update(
            step, system.field.density, step_generator(system.seed, Stream.STUDY, look, system.device)
        )


def coarsest_sampler(cfg: DictConfig, data: Data, system: System, samplers: list[Options]) -> Options:
    """The coarsest of some samplers with which a trained field renders as well as with the best, and prints a line for each.

    Args:
        cfg: with whose sampler the field was trained.
        data: whose held-out views measure it.
        system: the field.
        samplers: options, coarsest first; those that its sampler does not have are left out.

    Raises:
        InputError: where they ask for more memory than is free.
    """
    known = inspect.signature(target_of(cfg, "sampler")).parameters if isinstance(system, NeRF3D) else {}
    samplers = [options for options in samplers if options.keys() <= known.keys()]
    if not samplers or not isinstance(system, NeRF3D) or not isinstance(data, RayDataModule):
        return {}
    scores = []
    for options in samplers:
        probe = build_system(set_options(cfg, "sampler", options), frame_of(data), system.device)
        assert isinstance(probe, NeRF3D)  # of the same data
        check_room(probe, data, system.device)
        probe.field = system.field
        probe.to(system.device)
        probe.sampler.look_through(data.scene.train.cameras)
        settle(probe)
        scores.append(quality(probe.eval(), data))
        print(f"sampler {options}: {scores[-1]:.2f} dB", flush=True)
    enough = max(scores) - AS_GOOD
    return next(options for options, score in zip(samplers, scores, strict=True) if score >= enough)
