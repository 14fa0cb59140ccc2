"""What a training step costs on a device: time, operations, waits of the host and memory, and how its time grows."""

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean, median

import torch
from omegaconf import DictConfig

from benchmarks.agreement import FAILURES, failure
from benchmarks.count import Count
from benchmarks.methods import METHODS
from benchmarks.tables import Row, Rows, named
from nerf_lightning.callbacks.results import peak_memory_bytes
from nerf_lightning.config.build import build_data, build_system, frame_of
from nerf_lightning.config.compose import composed
from nerf_lightning.config.limits import limits_of
from nerf_lightning.dataset import RayDataModule, Views
from nerf_lightning.dataset.resize import resize_views
from nerf_lightning.system import NeRF3D
from nerf_lightning.system.growth import follow_resolution, grow_field, next_stage
from nerf_lightning.system.system import total_loss
from nerf_lightning.training.train import prepare
from nerf_lightning.utils.device import CPU, synchronize
from nerf_lightning.utils.libraries import silence_lightning
from nerf_lightning.utils.machine import cores
from nerf_lightning.utils.seeding import Stream, step_generator

WARMUP, PERIODS = 320, 6
"""Steps before the first that counts, and how many periods of the sampler's updates are timed after it."""
BLOCK, ROUNDS = 32, 10
"""Steps in a row at one point of a table; how often each point has its turn."""
PROGRESS = 0.5
"""The field has its full size from here on."""
SAMPLES, VIEWS, SIDES = (8192, 16384, 32768, 65536), (10, 100, 1000), (50, 100, 200)
DISTINCT = 10
"""Photos that are repeated to make more of them: the content, and with it the work, stays the same."""


def build(overrides: list[str], device: torch.device = CPU) -> tuple[DictConfig, RayDataModule, NeRF3D]:
    """Configuration, data and system of a 3D run, the process prepared as for training on a device, the system there."""
    with tempfile.TemporaryDirectory() as folder:
        cfg = composed(overrides, Path(folder))
        silence_lightning()
        prepare(cfg)
        data = build_data(cfg)
        data.enlarge(limits_of(cfg, device).batch)
        system = build_system(cfg, frame_of(data), device).to(device)
    if not isinstance(system, NeRF3D) or not isinstance(data, RayDataModule):
        raise TypeError("only 3D runs are measured here")
    follow_resolution(system, data)
    return cfg, data, system


def take_step(
    system: NeRF3D, data: RayDataModule, optimizer: torch.optim.Optimizer, step: int, progress: float
) -> float:
    """One step as NeRF3D does it under a Trainer, without Lightning, on the system's device. Returns its seconds."""
    synchronize(system.device)
    start = time.perf_counter()
    system.state.advance(progress)
    system.set_learning_rates(optimizer, step)
    if (stage := next_stage(system, step)) is not None:
        grow_field(system, data, stage, optimizer)
    batch, generator = data.draw(step).to(system.device), step_generator(system.seed, Stream.STEP, step, system.device)
    optimizer.zero_grad()
    system.sampler.update(step, system.field.density, generator)
    losses, system.stats = system.compute_losses(batch, generator)
    total_loss(losses).backward()
    optimizer.step()
    assert system.stats.squares is not None  # a NeRF3D's
    data.note_errors(system.stats.squares, system.stats.whole)
    if system.stats.counted:
        data.note_samples(system.stats.samples)
    synchronize(system.device)
    return time.perf_counter() - start


def forget_peak(device: torch.device) -> None:
    """Begins to count the device's memory anew, where it can."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    elif device.type == "mps":
        torch.mps.empty_cache()


def measure_method(overrides: list[str], device: torch.device) -> Row:
    """One line. Operations and waits are counted step by step over a whole period of the sampler's updates."""
    forget_peak(device)
    cfg, data, system = build(overrides, device)
    system.sampler.mark_invisible_cells(data.scene.train.cameras)
    optimizer = system.configure_optimizers()
    period = int(cfg.sampler.update_every)
    first = -(-WARMUP // period) * period

    def step(number: int) -> float:
        return take_step(system, data, optimizer, number, PROGRESS * min(1.0, number / first))

    for number in range(first):
        step(number)
    counts = []
    for number in range(first, first + period):
        with Count() as count:
            step(number)
        counts.append((count.operations, count.waits))
    times, samples, rays = [], [], []
    for number in range(first + period, first + (1 + PERIODS) * period):
        times.append(1e3 * step(number))
        if system.stats.counted:
            samples.append(system.stats.samples)
        rays.append(system.stats.rays)
    between, whole = counts[1:] or counts, counts  # the first step of a period updates the sampler
    return {
        "scene": data.scene.name,
        "step_ms": median(times),
        "operations": median(operations for operations, _ in between),
        "waits": median(waits for _, waits in between),
        "operations_on_average": fmean(operations for operations, _ in whole),
        "waits_on_average": fmean(waits for _, waits in whole),
        "samples": fmean(samples) if samples else None,
        "rays": fmean(rays),
        "peak_memory_bytes": peak_memory_bytes(device),
    }


def measure_methods(device: torch.device, experiment: str, overrides: list[str]) -> Rows:
    """A line a method, of the shipped size."""
    rows: Rows = []
    for name in METHODS:
        print(f"speed: {name}: {WARMUP} steps until it has its full size, then {PERIODS} rounds", flush=True)
        try:
            row = measure_method([f"+experiment={experiment}", f"recipe={name}_medium", *overrides], device)
        except FAILURES as error:
            row = {"differs": f"a step of full size {failure(error)}"}
        rows.append({"method": name, **row})
    return rows


def block_ms(system: NeRF3D, data: RayDataModule, optimizer: torch.optim.Optimizer, first: int, steps: int) -> float:
    """Milliseconds of a step, the mean over the later half of some: by then the number of rays has found its level."""
    times = [take_step(system, data, optimizer, first + i, PROGRESS) for i in range(steps)]
    return 1e3 * fmean(times[steps // 2 :])


def in_turn(points: list[Callable[[int], float]]) -> list[tuple[float, list[float]]]:
    """Times of several points, block after block in turn: the median of each, and all of its rounds."""
    rounds = [[point(turn) for point in points] for turn in range(ROUNDS)]
    columns = [list(column) for column in zip(*rounds, strict=True)]
    return [(median(column), column) for column in columns]


def measure_growth(overrides: list[str]) -> Rows:
    """Milliseconds of a step with samples a step, photos, and their size, all measured on one field in training.

    `ratio` is that to the axis's first point, the median over rounds.
    """
    cfg, data, system = build(overrides)
    optimizer, train = system.configure_optimizers(), data.scene.train

    def variant(train: Views, samples: int | None) -> RayDataModule:
        return RayDataModule(replace(data.scene, train=train), rays=data.rays, samples=samples, seed=cfg.seed)

    repeated = {n: train[torch.as_tensor(torch.arange(n) % DISTINCT)] for n in VIEWS}
    points = [
        *(("samples a step", n, variant(train, n)) for n in SAMPLES),
        *(("photos", n, variant(views, data.samples)) for n, views in repeated.items()),
        *(("pixels along a side", n, variant(resize_views(train, n), data.samples)) for n in SIDES),
    ]
    block_ms(system, data, optimizer, 0, WARMUP)
    for _, _, other in points:
        block_ms(system, other, optimizer, 0, BLOCK)

    def run_block(other: RayDataModule, turn: int) -> float:
        return block_ms(system, other, optimizer, BLOCK * turn, BLOCK)

    found = in_turn([partial(run_block, other) for _, _, other in points])
    first: dict[str, list[float]] = {}
    rows: Rows = []
    for (axis, value, _), (time_ms, column) in zip(points, found, strict=True):
        start = first.setdefault(axis, column)
        ratio = median(a / b for a, b in zip(column, start, strict=True))
        rows.append({"axis": axis, "value": value, "step_ms": time_ms, "ratio": ratio})
    return rows


def measure_threads(experiment: str, overrides: list[str]) -> Rows:
    """Milliseconds of a step on 1, 2, 4, ... threads, as many as there are cores, measured in turn.

    `efficiency` is the share of those threads that one thread's time explains, the median over rounds.
    """
    counts, before = [2**power for power in range(cores().bit_length())], torch.get_num_threads()
    _, data, system = build([f"+experiment={experiment}", *overrides])
    optimizer = system.configure_optimizers()
    block_ms(system, data, optimizer, 0, WARMUP)

    def run_block(count: int, turn: int) -> float:
        torch.set_num_threads(count)
        return block_ms(system, data, optimizer, WARMUP + BLOCK * turn, BLOCK)

    found = in_turn([partial(run_block, count) for count in counts])
    torch.set_num_threads(before)
    rows: Rows = []
    for count, (time_ms, column) in zip(counts, found, strict=True):
        efficiency = median(one / (count * each) for one, each in zip(found[0][1], column, strict=True))
        rows.append({"experiment": experiment, "threads": count, "step_ms": time_ms, "efficiency": efficiency})
    return rows


def measure(args: argparse.Namespace) -> Rows:
    """The step of each method; on a CPU also how it grows, how threads share it, and what Lightning adds."""
    from benchmarks.overhead import measure_overhead  # which takes steps from here

    experiment = args.experiments[0]
    tables = {"steps": measure_methods(args.device, experiment, args.overrides)}
    if args.device == CPU:
        given = [f"+experiment={experiment}", *args.overrides]
        tables["growth"] = measure_growth(given)
        tables["threads"] = [row for name in args.experiments for row in measure_threads(name, args.overrides)]
        tables["overhead"] = [measure_overhead(given)]
    return named(tables)
