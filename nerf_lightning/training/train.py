"""Training: one run, from a composed configuration to the files in its folder."""

import logging
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.callbacks import LambdaCallback
from omegaconf import DictConfig

from nerf_lightning.callbacks import Budget, LiveViewer
from nerf_lightning.callbacks.results import summarize_run
from nerf_lightning.callbacks.trainer_access import find_callback
from nerf_lightning.config import build
from nerf_lightning.config.limits import get_limits
from nerf_lightning.dataset import DataModule, Scene
from nerf_lightning.errors import DiskFullError, InputError
from nerf_lightning.runs.find import link_latest
from nerf_lightning.runs.folder import save_config
from nerf_lightning.runs.run_lock import delete_run_outputs
from nerf_lightning.runs.scene_file import save_scene
from nerf_lightning.system import System
from nerf_lightning.training.loggers import finish_wandb, log_summary
from nerf_lightning.training.process import check_processes, prepare_process, warm_up
from nerf_lightning.training.report import report_photos, report_results
from nerf_lightning.training.resume import compose_resumed_config, load_data
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.libraries import silence_lightning
from nerf_lightning.utils.memory import check_memory, out_of_memory_error

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingRun:
    """Objects of a training run."""

    cfg: DictConfig
    folder: Path
    data: DataModule
    system: System
    trainer: L.Trainer
    warnings: list[str]
    """Issues found in the photos."""


@finish_wandb()
def train(
    cfg: DictConfig, checkpoint: Path | None = None, folder: Path | None = None, scene: Scene | None = None
) -> float:
    """Trains and evaluates a run. Returns the held-out PSNR in dB.

    Args:
        cfg: the configuration; with `resume`, replaced by the resumed run's.
        checkpoint: state of a run with the same configuration, to continue from.
        folder: where to write, locked by the caller (see `runs/run_lock.py`); None takes Hydra's.
        scene: to train on, if already loaded; None loads the configuration's.

    Raises:
        InputError: for bad input, mostly before anything is written into the run's folder.
    """
    folder = folder or Path(HydraConfig.get().runtime.output_dir)
    is_resumed = cfg.resume is not None
    if is_resumed:
        cfg, checkpoint = compose_resumed_config(cfg, folder)
    device = prepare(cfg)
    data = load_data(cfg, scene, folder if is_resumed else None)
    run = build_run(cfg, data, device, folder, checkpoint)
    results = fit_and_test(run, checkpoint)
    if run.trainer.is_global_zero:
        summarize(run, results)
    if (live := find_callback(run.trainer, LiveViewer)) is not None:
        in_sweep = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
        live.finish(results["psnr"], keep_open=not in_sweep)
    quality: float | None = results["psnr"]
    return math.nan if quality is None else quality  # a diverged field may have none


def prepare(cfg: DictConfig) -> torch.device:
    """Sets up the process and checks the options of all groups. Returns the device."""
    device = build.resolve_run_device(cfg)
    silence_lightning()
    prepare_process(cfg)
    build.check_groups(cfg)
    return device


def build_run(
    cfg: DictConfig, data: DataModule, device: torch.device, folder: Path, checkpoint: Path | None
) -> TrainingRun:
    """Builds system and trainer, checks that they fit the data, and empties the folder unless a run continues."""
    data.scale_batch(get_limits(cfg, device).batch_scale)
    issues = data.find_issues(build.has_pose_refinement(cfg))
    for issue in issues:
        log.warning("%s: %s", data.scene.name, issue.text)
    system = prepare_system(cfg, data, device, any(issue.has_wrong_poses for issue in issues))
    trainer = build.build_trainer(cfg, folder, device)
    check_processes(trainer)
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if check := getattr(callback, "check", None):
            check(data)
    if trainer.is_global_zero:
        if checkpoint is None:
            delete_run_outputs(folder)
        description = LambdaCallback(on_train_start=lambda *_: write_description(cfg, data, folder))
        trainer.callbacks.insert(0, description)  # type: ignore[attr-defined]
    with trainer.precision_plugin.train_step_context():
        warm_up(system, data, trainer.strategy.root_device)
    return TrainingRun(cfg, folder, data, system, trainer, [issue.text for issue in issues])


def write_description(cfg: DictConfig, data: DataModule, folder: Path) -> None:
    """Writes what reopens a run, once training starts: a run whose state does not fit stays as it was."""
    save_config(cfg, folder)
    save_scene(data, folder)
    link_latest(folder)


def prepare_system(cfg: DictConfig, data: DataModule, device: torch.device, has_wrong_poses: bool) -> System:
    """Builds the system to train.

    Raises:
        InputError: if it needs more memory than is free, at its largest, or does not fit the data.
    """
    system = build.build_system(cfg, build.get_metadata(data), device)
    contents = "numbers, with their gradients and moments,"
    check_memory("config", "model", contents, system.field.training_bytes, "choose a smaller one", device)
    if system.corrections is not None and has_wrong_poses:
        system.corrections.enable_poses()
    if system.field.size_message:
        log.info("model: %s", system.field.size_message)
    return system


def fit_and_test(run: TrainingRun, checkpoint: Path | None) -> dict[str, Any]:
    """Trains, evaluates and writes results.json, also of a run that ends early. Returns its content."""
    trainer, path = run.trainer, run.folder / "results.json"
    options = trainer, run.system, run.cfg.method, run.cfg.seed, run.warnings
    try:
        fit(run, checkpoint)
        trainer.test(run.system, run.data, verbose=False)
    except BaseException as error:
        if trainer.is_global_zero and has_trained(trainer, error):
            with suppress(DiskFullError):  # report the first error, not a full disk
                write_json(path, summarize_run(*options, error))
        raise
    results = summarize_run(*options)
    if trainer.is_global_zero:
        write_json(path, results)
    return results


def fit(run: TrainingRun, checkpoint: Path | None) -> None:
    """Trains, from a checkpoint if given.

    Raises:
        InputError: if the checkpoint does not fit the run.
    """
    try:
        run.trainer.fit(run.system, run.data, ckpt_path=checkpoint, weights_only=True)
    except Exception as error:
        if not has_trained(run.trainer, error) and checkpoint is None and run.trainer.is_global_zero:
            delete_run_outputs(run.folder)
        if checkpoint is None or run.system.state.clock.has_started or isinstance(error, InputError):
            raise
        problem = f"cannot be resumed ({type(error).__name__}: {error})"  # nothing but the checkpoint was read yet
        raise InputError(checkpoint, "", problem, hint="start the run anew") from error


def has_trained(trainer: L.Trainer, error: BaseException) -> bool:
    """Whether an error came after the start of training, and not from a first step that ran out of memory."""
    clock = Budget.find(trainer).state.clock
    return clock.has_started and not (trainer.global_step == 0 and out_of_memory_error(error))


def summarize(run: TrainingRun, results: dict[str, Any]) -> None:
    """Saves refined cameras, logs the final metrics, and prints the results."""
    report_photos(run.system, run.data, results, run.folder)
    if run.trainer.logger is not None:
        log_summary(run.trainer.logger, build.resolve_config(run.cfg), results)
    report_results(results, run.folder, run.trainer.logger)
