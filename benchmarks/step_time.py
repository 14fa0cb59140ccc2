"""Cost of a training step on a device: time, operations, host syncs and memory."""

import argparse
import tempfile
import time
from pathlib import Path
from statistics import fmean, median, quantiles
from typing import Any

import lightning as L
import torch
from omegaconf import DictConfig

from benchmarks.agreement import DEVICE_ERRORS, describe_failure
from benchmarks.methods import METHODS
from benchmarks.op_counter import OpCounter
from benchmarks.tables import Row, Rows, name_tables
from nerf_lightning.callbacks.evaluation import get_peak_memory_bytes
from nerf_lightning.config.build import build_data, build_system, build_trainer, get_metadata, resolve_run_device
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.limits import get_limits
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.system import NeRF3D
from nerf_lightning.system.growth import compute_next_stage, sync_resolution_scale, upsample_field
from nerf_lightning.system.system import sum_losses
from nerf_lightning.training.process import prepare_process
from nerf_lightning.utils.device import CPU, synchronize
from nerf_lightning.utils.libraries import silence_lightning
from nerf_lightning.utils.seeding import Stream, step_generator

WARMUP_STEPS, TIMED_PERIODS = 320, 6
"""Untimed steps, and the number of timed periods of the sampler's updates."""
PROGRESS = 0.5
"""Training progress from which on the field has its full size."""
BLOCK_STEPS = 32
"""Consecutive steps of one kind: two updates of the occupancy grid, short against changes of the machine's load."""
NUM_BLOCKS, FIRST_TIMED_BLOCK = 50, 10
"""Blocks of each kind, and the first timed one."""


def build(overrides: list[str], device: torch.device = CPU) -> tuple[DictConfig, RayDataModule, NeRF3D]:
    """Builds configuration, data and system of a 3D run on a device, and prepares the process as for training."""
    with tempfile.TemporaryDirectory() as folder:
        cfg = compose_config(overrides, Path(folder))
        silence_lightning()
        prepare_process(cfg)
        data = build_data(cfg)
        data.scale_batch(get_limits(cfg, device).batch_scale)
        system = build_system(cfg, get_metadata(data), device).to(device)
    if not isinstance(system, NeRF3D) or not isinstance(data, RayDataModule):
        raise TypeError("only 3D runs are measured here")
    sync_resolution_scale(system, data)
    return cfg, data, system


def run_plain_step(
    system: NeRF3D, data: RayDataModule, optimizer: torch.optim.Optimizer, step: int, progress: float
) -> float:
    """Runs one training step of NeRF3D without Lightning; returns its seconds."""
    synchronize(system.device)
    start = time.perf_counter()
    system.state.set_progress(progress)
    system.set_learning_rates(optimizer, step)
    if (stage := compute_next_stage(system, step)) is not None:
        upsample_field(system, data, stage, optimizer)
    batch, generator = data.draw(step).to(system.device), step_generator(system.seed, Stream.STEP, step, system.device)
    optimizer.zero_grad()
    system.sampler.update(step, system.field.density, generator)
    losses, system.stats = system.compute_losses(batch, generator)
    sum_losses(losses).backward()
    optimizer.step()
    assert system.stats.squared_errors is not None
    data.update_error_map(system.stats.squared_errors, system.stats.complete_rays)
    data.adapt_num_rays(system.stats.samples)
    synchronize(system.device)
    return time.perf_counter() - start


def reset_peak_memory(device: torch.device) -> None:
    """Resets the device's peak memory counter, where there is one."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    elif device.type == "mps":
        torch.mps.empty_cache()


def measure_method(overrides: list[str], device: torch.device) -> Row:
    """Measures one method; operations and syncs are counted over one period of the sampler's updates."""
    reset_peak_memory(device)
    cfg, data, system = build(overrides, device)
    system.sampler.mark_invisible_cells(data.scene.train.cameras)
    optimizer = system.configure_optimizers()
    period = int(cfg.sampler.update_every)
    first = -(-WARMUP_STEPS // period) * period

    def step(number: int) -> float:
        return run_plain_step(system, data, optimizer, number, PROGRESS * min(1.0, number / first))

    for number in range(first):
        step(number)
    counts = []
    for number in range(first, first + period):
        with OpCounter() as count:
            step(number)
        counts.append((count.operations, count.waits))
    times, samples, rays = [], [], []
    for number in range(first + period, first + (1 + TIMED_PERIODS) * period):
        times.append(1e3 * step(number))
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
        "peak_memory_bytes": get_peak_memory_bytes(device),
    }


def measure_methods(device: torch.device, experiment: str, overrides: list[str]) -> Rows:
    """Measures all methods in their default size, one row each."""
    rows: Rows = []
    for name in METHODS:
        print(f"step_time: {name}: {WARMUP_STEPS} steps to its full size, then {TIMED_PERIODS} periods", flush=True)
        try:
            row = measure_method([f"+experiment={experiment}", f"recipe={name}_medium", *overrides], device)
        except DEVICE_ERRORS as error:
            row = {"differs": f"a step of full size {describe_failure(error)}"}
        rows.append({"method": name, **row})
    return rows


class Alternation(L.Callback):
    """Alternates blocks of the Trainer's steps with blocks of plain steps: same field, optimizer and photos.

    The last step of a block is not timed: in the Trainer's it includes this callback.
    """

    def __init__(self, data: RayDataModule) -> None:
        self.data = data
        self.trainer_blocks: list[float] = []
        """Mean seconds per step of each block."""
        self.bare_blocks: list[float] = []
        self._starts: list[float] = []

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: NeRF3D, batch: Any, batch_idx: int) -> None:
        step = trainer.global_step
        if step and step % BLOCK_STEPS == 0:
            self.trainer_blocks.append((self._starts[-1] - self._starts[0]) / (BLOCK_STEPS - 1))
            optimizer = pl_module.optimizers(use_pl_optimizer=False)
            assert isinstance(optimizer, torch.optim.Optimizer)
            steps = range(step - BLOCK_STEPS, step)
            times = [run_plain_step(pl_module, self.data, optimizer, past, pl_module.state.progress) for past in steps]
            self.bare_blocks.append(fmean(times[:-1]))
            self._starts = []
        self._starts.append(time.perf_counter())


def measure_overhead(overrides: list[str]) -> dict[str, float]:
    """Milliseconds per step, plain and under a Trainer with all callbacks and the logger, in alternating blocks of one run.

    Validation and snapshots are disabled; the overhead is the median over pairs of neighboring blocks, with quartiles.
    """
    steps = NUM_BLOCKS * BLOCK_STEPS + 1
    disabled = "callbacks.validation.fractions=[]", "callbacks.snapshots.steps=[]"
    cfg, data, system = build([*overrides, f"budget.steps={steps}", *disabled])
    plain_data = RayDataModule(data.scene, data.rays, data.samples, cfg.seed)  # the Trainer advances the other's state
    sync_resolution_scale(system, plain_data)
    with tempfile.TemporaryDirectory() as folder:
        trainer, alternation = build_trainer(cfg, Path(folder), resolve_run_device(cfg)), Alternation(plain_data)
        trainer.callbacks.insert(0, alternation)  # type: ignore[attr-defined]
        trainer.fit(system, data)
    full, bare = alternation.trainer_blocks[FIRST_TIMED_BLOCK:], alternation.bare_blocks[FIRST_TIMED_BLOCK:]
    lower, middle, upper = quantiles([100 * (a / b - 1) for a, b in zip(full, bare, strict=True)])
    times = {"bare_ms": 1e3 * median(bare), "trainer_ms": 1e3 * median(full)}
    return times | {"overhead_percent": middle, "lower_quartile": lower, "upper_quartile": upper}


def measure(args: argparse.Namespace) -> Rows:
    """Measures the step of each method; on a CPU also Lightning's overhead."""
    experiment = args.experiments[0]
    tables = {"steps": measure_methods(args.device, experiment, args.overrides)}
    if args.device == CPU:
        tables["overhead"] = [measure_overhead([f"+experiment={experiment}", *args.overrides])]
    return name_tables(tables)
