"""Cost of a training step on a device: time, operations, bytes, host syncs and memory."""

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from benchmarks.methods import METHODS
from benchmarks.op_counter import OpCounter
from benchmarks.tables import Row, Rows
from nerf_lightning.callbacks.evaluation import get_peak_memory_bytes
from nerf_lightning.config.build import build_data, build_system, get_metadata
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.limits import get_limits
from nerf_lightning.dataset import RayDataModule, Views
from nerf_lightning.dataset.ray_datamodule import STEPS_PER_DRAW
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
DEFAULT_PERIOD = 16
"""Steps of a period of a sampler without updates."""
PROFILE_ROWS, MAX_NAME_LENGTH = 15, 70


@dataclass
class Training:
    """A 3D run that trains step by step, without Lightning and CUDA graphs."""

    data: RayDataModule
    photos: Views
    """Copy of the data's photos on the device."""
    system: NeRF3D
    optimizer: torch.optim.Optimizer
    period: int
    """Steps between updates of the sampler."""
    growth_steps: int
    """Steps until the field has its full size, whole periods."""
    next_step: int = 0

    def step(self) -> float:
        """Runs the next step; returns its seconds."""
        data, system, number = self.data, self.system, self.next_step
        synchronize(system.device)
        start = time.perf_counter()
        system.state.set_progress(PROGRESS * min(1.0, number / self.growth_steps))
        system.set_learning_rates(self.optimizer, number)
        if (stage := compute_next_stage(system, number)) is not None:
            upsample_field(system, data, stage, self.optimizer)
        batch = data.draw_batch(self.photos, number, slice(None))
        generator = step_generator(system.seed, Stream.STEP, number, system.device)
        self.optimizer.zero_grad()
        system.sampler.update(number, system.field.density, generator)
        losses, system.stats = system.compute_losses(batch, generator)
        sum_losses(losses).backward()
        self.optimizer.step()
        assert system.stats.squared_errors is not None
        data.update_error_map(system.stats.squared_errors, system.stats.complete_rays)
        self.adapt_num_rays(number)
        synchronize(system.device)
        self.next_step += 1
        return time.perf_counter() - start

    def adapt_num_rays(self, number: int) -> None:
        """As `NeRF3D.adapt_num_rays`, after a step."""
        steps = 1 if self.system.device == CPU else STEPS_PER_DRAW
        if (number + 1) % steps == 0:
            self.system.sampler.read_counts()
            per_ray, stats = self.system.sampler.samples_per_ray, self.system.stats
            self.data.adapt_num_rays(stats.samples if per_ray is None else round(per_ray * stats.rays), steps)


def start_training(overrides: list[str], device: torch.device, steps: int = WARMUP_STEPS) -> Training:
    """Builds a 3D run, prepares the process as for training, and trains until the field has its full size."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
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
    system.sampler.mark_invisible_cells(data.scene.train.cameras)
    period = int(cfg.sampler.get("update_every", DEFAULT_PERIOD))
    growth_steps = -(-steps // period) * period
    training = Training(data, data.photos.to(device), system, system.configure_optimizers(), period, growth_steps)
    for _ in range(growth_steps):
        training.step()
    return training


def measure_steps(training: Training, periods: int = TIMED_PERIODS) -> Row:
    """Measures time, operations, bytes, syncs and memory of a training's next steps."""
    counts, times, samples, rays = [], [], [], []
    for _ in range(training.period):
        with OpCounter() as count:
            training.step()
        counts.append(count)
    for _ in range(periods * training.period):
        times.append(1e3 * training.step())
        samples.append(training.system.stats.samples)
        rays.append(training.system.stats.rays)
    figures = {key: [getattr(count, key) for count in counts] for key in ("operations", "bytes", "waits")}
    return {
        "scene": training.data.scene.name,
        "step_ms": median(times),
        # The first step of a period updates the sampler.
        **{key: median(values[1:] or values) for key, values in figures.items()},
        **{f"{key}_on_average": fmean(values) for key, values in figures.items()},
        "samples": fmean(samples),
        "rays": fmean(rays),
        "peak_memory_bytes": get_peak_memory_bytes(training.system.device),
    }


def profile_step(training: Training) -> Rows:
    """Profiles a step between updates: kernels by time on a GPU, operations by time on a CPU, all of them together first."""
    if training.next_step % training.period == 0:
        training.step()
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if training.system.device.type == "cuda" else [])]
    with profile(activities=activities) as profiler:
        training.step()
    events = [event for event in profiler.key_averages() if not event.is_user_annotation]
    kernels = [event for event in events if event.device_type == DeviceType.CUDA]
    by_name = {
        event.key: (event.count, 1e-3 * (event.self_device_time_total if kernels else event.self_cpu_time_total))
        for event in kernels or events
    }
    calls, total = (sum(column) for column in zip(*by_name.values(), strict=True))
    slowest = sorted(by_name.items(), key=lambda item: -item[1][1])[:PROFILE_ROWS]
    return [
        {"kernel": name[:MAX_NAME_LENGTH], "calls": count, "ms": ms, "percent": 100 * ms / total}
        for name, (count, ms) in [("all", (calls, total)), *slowest]
    ]


def measure(args: argparse.Namespace) -> Iterator[Row]:
    """Measures the step of each recipe, by default of all methods."""
    for recipe in args.recipes or [f"{name}_medium" for name in METHODS]:
        print(f"step_time: {recipe}: {WARMUP_STEPS} steps to its full size, then {TIMED_PERIODS} periods", flush=True)
        options = [f"+experiment={args.experiments[0]}", f"recipe={recipe}", *args.overrides]
        yield {"method": recipe, **measure_steps(start_training(options, args.device, WARMUP_STEPS), TIMED_PERIODS)}
