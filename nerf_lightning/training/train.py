"""One training run, from a composed configuration to the files in its folder."""

import copy
import logging
import math
import shlex
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from nerf_lightning.callbacks import Budget, Live
from nerf_lightning.callbacks.attached import ChecksData, attached
from nerf_lightning.callbacks.results import summarize_run
from nerf_lightning.config.build import (
    build_data,
    build_system,
    build_trainer,
    check_background,
    check_groups,
    corrects_poses,
    device_of,
    frame_of,
    resolved,
    with_photos,
)
from nerf_lightning.config.limits import limits_of
from nerf_lightning.config.literal import escape
from nerf_lightning.dataset import PixelBatch, PixelDataModule, RayDataModule, Scene, draw_rays
from nerf_lightning.dataset.plausible import check_scene
from nerf_lightning.errors import InputError, NoRoom
from nerf_lightning.kernels import use_kernels
from nerf_lightning.refine import format_report, summarize_corrections
from nerf_lightning.runs.checkpoint import RESUME_KEYS, read_checkpoint
from nerf_lightning.runs.data import data_again
from nerf_lightning.runs.find import link_latest
from nerf_lightning.runs.folder import load_config, save_config
from nerf_lightning.runs.owner import clear
from nerf_lightning.runs.scene_file import load_scene, save_scene
from nerf_lightning.system import NeRF2D, NeRF3D, System
from nerf_lightning.system.compiled import BACKEND, check_compiler
from nerf_lightning.system.system import total_loss
from nerf_lightning.training.loggers import TensorBoard, finishing_wandb, log_summary
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.libraries import silence_lightning
from nerf_lightning.utils.machine import CROWDED, crowding
from nerf_lightning.utils.memory import check_memory, keep_freed_memory, out_of_memory
from nerf_lightning.utils.progress import animates
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.text import join_truncated

MAX_NAMED = 10
"""Photos that do not fit which are printed; all stand in results.json."""
log = logging.getLogger(__name__)


class Described(L.Callback):
    """Writes what opens a run again once its training begins: a resumed run stays as it was where its state does not fit."""

    def __init__(self, cfg: DictConfig, data: RayDataModule | PixelDataModule, folder: Path):
        self.cfg, self.data, self.folder = cfg, data, folder

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        save_config(self.cfg, self.folder)
        save_scene(self.data, self.folder)
        link_latest(self.folder)
        if isinstance(trainer.logger, TensorBoard):
            trainer.logger.log_config(self.folder / "config.yaml")


@finishing_wandb()
def train(
    cfg: DictConfig, checkpoint: Path | None = None, folder: Path | None = None, scene: Scene | None = None
) -> float:
    """Builds, fits, tests, writes. Returns the held-out PSNR in dB.

    Args:
        cfg: the configuration; with `resume`, the resumed run's takes its place.
        checkpoint: state of a run with the same configuration, to continue from.
        folder: where to write, which the caller owns (see `runs/owner.py`); None takes Hydra's.
        scene: to train on, if already loaded; None loads the configuration's.

    Raises:
        InputError: for bad input, mostly before anything is written into the run's folder.
    """
    folder = folder or Path(HydraConfig.get().runtime.output_dir)
    resumed = cfg.resume is not None
    if resumed:
        cfg, checkpoint = resume(cfg, folder)
    device = device_of(cfg)
    silence_lightning()
    prepare(cfg, may_compile=True)
    if cfg.compile:
        check_compiler(device, BACKEND)
    check_groups(cfg)
    data = load_data(cfg, scene, folder if resumed else None)
    data.enlarge(limits_of(cfg, device).batch)
    doubts = check_scene(data.scene, corrects_poses(cfg)) if isinstance(data, RayDataModule) else []
    for doubt in doubts:
        log.warning("%s: %s", data.scene.name, doubt.text)
    system = prepare_system(cfg, data, device, any(doubt.far_off for doubt in doubts))
    trainer = build_trainer(cfg, folder, device)
    check_processes(trainer)
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, ChecksData):
            callback.check(data)
    if trainer.is_global_zero:
        if checkpoint is None:
            clear(folder)
        trainer.callbacks.insert(0, Described(cfg, data, folder))  # type: ignore[attr-defined]
    with trainer.precision_plugin.train_step_context():
        warm_up(system, data, trainer.strategy.root_device)
    summarize = partial(summarize_run, trainer, system, cfg.method, cfg.seed, [doubt.text for doubt in doubts])
    path = folder / "results.json"
    try:
        fit(trainer, system, data, checkpoint, folder)
        trainer.test(system, data, verbose=False)
    except BaseException as error:
        if trainer.is_global_zero and has_trained(trainer, error):
            with suppress(NoRoom):  # on a full disk what happened first is to be told
                write_json(path, summarize(error))
        raise
    results = summarize()
    if trainer.is_global_zero:
        write_json(path, results)
        report_photos(system, data, results, folder)
        if trainer.logger is not None:
            log_summary(trainer.logger, resolved(cfg), results)
        report(results, folder, trainer.logger)
    live = attached(trainer, Live)
    if live is not None:
        in_sweep = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
        live.finish(results["psnr"], stay=not in_sweep)
    quality: float | None = results["psnr"]
    return math.nan if quality is None else quality  # views of a field that has broken down may have none


def load_data(cfg: DictConfig, scene: Scene | None, resumed: Path | None) -> RayDataModule | PixelDataModule:
    """The data to train on: a loaded scene, that of a resumed run in its frame, or the configuration's."""
    if resumed is not None:
        return data_again(cfg, load_scene(resumed), cfg.dataset.get("path"), corrected=False)
    if scene is None:
        return build_data(cfg)
    return RayDataModule(scene, *(cfg.dataset[key] for key in ("rays", "samples", "seed", "focus")))


def prepare_system(
    cfg: DictConfig, data: RayDataModule | PixelDataModule, device: torch.device, poses_are_off: bool
) -> System:
    """The system to train.

    Raises:
        InputError: it needs more memory than is free, trained at its largest, or does not fit the data.
    """
    system = build_system(cfg, frame_of(data), device)
    what = "numbers, with their gradients and moments,"
    check_memory("config", "model", what, system.field.training_bytes, "choose a smaller one", device)
    if isinstance(system, NeRF3D) and system.corrections is not None and poses_are_off:
        system.corrections.enable_poses_at_once()
    if system.field.sizing:
        log.info("model: %s", system.field.sizing)
    check_background(cfg, data, system)
    return system


def fit(
    trainer: L.Trainer,
    system: System,
    data: RayDataModule | PixelDataModule,
    checkpoint: Path | None,
    folder: Path,
) -> None:
    """Trains, from a checkpoint if there is one.

    Raises:
        InputError: where the checkpoint does not fit the run.
    """
    try:
        trainer.fit(system, data, ckpt_path=checkpoint, weights_only=True)
    except Exception as error:
        if not has_trained(trainer, error) and checkpoint is None and trainer.is_global_zero:
            clear(folder)
        if checkpoint is None or Budget.of(trainer).state.clock.started or isinstance(error, InputError):
            raise
        found = f"{type(error).__name__}: {error}"  # only the checkpoint has been at work yet
        raise InputError(checkpoint, "", found, "a state of this run to continue from", "start the run anew") from error


def has_trained(trainer: L.Trainer, error: BaseException) -> bool:
    """Whether an error came after the start of training, and not from a first step that did not fit into memory."""
    return Budget.of(trainer).state.clock.started and not (trainer.global_step == 0 and out_of_memory(error))


def report_photos(system: System, data: RayDataModule | PixelDataModule, results: dict[str, Any], folder: Path) -> None:
    """Saves corrected cameras, and prints what training has found out about the photos."""
    if isinstance(system, NeRF3D) and system.corrections is not None and system.corrections.is_finite:
        assert isinstance(data, RayDataModule)  # what build_system makes a NeRF3D for
        if "poses" in system.corrections.enabled_at:
            cameras = system.corrections.poses.refine_cameras(data.scene.train.cameras)
            save_scene(data, folder, cameras, summarize_corrections(system.corrections)["focal_factor"])
        found = results["psnr_aligned"]
        aligned = "" if found is None else f"; {found:.2f} dB held out with held-out photos corrected too"
        print(format_report(system.corrections, data.scene.train.name) + aligned)
    if results["misfits"]:
        named = join_truncated([f"{one['photo']} ({one['psnr']:.1f} dB)" for one in results["misfits"]], MAX_NAMED)
        print(f"training photos that do not fit the others (a wrong pose, or something moved): {named}")


def resume(cfg: DictConfig, folder: Path) -> tuple[DictConfig, Path]:
    """The configuration of the run in `folder` with this command line's overrides on top, and its last checkpoint."""
    saved = load_config(folder)
    checkpoint = folder / "checkpoints" / "last.ckpt"
    read_checkpoint(checkpoint, RESUME_KEYS)  # fails in one line before anything starts, if it is broken
    given = [override.partition("=")[0].lstrip("+") for override in HydraConfig.get().overrides.task]
    if "dataset.path" in given and cfg.dataset.path is not None:
        saved = with_photos(saved, cfg.dataset.path)
    for key in given:
        if key == "resume":
            continue
        if OmegaConf.select(saved, key, default=key) is key:
            raise InputError("resume", key, "an option the run does not have", f"one of those in {folder}/config.yaml")
        value = OmegaConf.select(cfg, key)
        OmegaConf.update(saved, key, escape(resolved(value) if isinstance(value, DictConfig) else value), merge=False)
    if "device" in given:  # the trainer's was resolved when the run began
        OmegaConf.update(saved, "trainer.accelerator", cfg.trainer.accelerator)
    return saved, checkpoint


def prepare(cfg: DictConfig, may_compile: bool = False) -> None:
    """Sets what applies to the whole process; with `may_compile`, for a compiled step if the run asks for one.

    Raises:
        InputError: for kernels that there are not.
    """
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    use_kernels("reference" if may_compile and cfg.compile else cfg.kernels)
    keep_freed_memory()
    torch.set_flush_denormal(True)  # tiny weights otherwise slow the CPU down many times
    L.seed_everything(cfg.seed, verbose=False)


def check_processes(trainer: L.Trainer) -> None:
    """Refuses what several processes cannot share.

    Raises:
        InputError: for a sweep whose jobs would start further processes.
    """
    if trainer.world_size == 1:
        return
    cluster = getattr(trainer.strategy, "cluster_environment", None)
    if HydraConfig.get().mode == RunMode.MULTIRUN and not getattr(cluster, "creates_processes_externally", False):
        todo = "or a launcher that starts the processes itself"
        processes = str(trainer.world_size)
        raise InputError("config", "trainer.devices", processes, "one process a job in a sweep", todo)


def warm_up(system: System, data: RayDataModule | PixelDataModule, device: torch.device) -> None:
    """Runs a small step on a copy, so that kernels are compiled before the clock starts.

    A CPU's kernels are compiled once and cached; those of `compile`, in every process.
    """
    compiled = device.type == "cpu" or system.backend is not None
    told = " (the first time they are compiled: half a minute)" if compiled else ""
    console = Console()
    with console.status(f"getting the kernels ready{told}") if animates(console) else nullcontext():
        trial = copy.deepcopy(system).to(device)
        if isinstance(trial, NeRF3D):
            assert isinstance(data, RayDataModule)  # what build_system makes a NeRF3D for
            generator, plain = step_generator(0, Stream.BATCH, 0), trial.renderer.uses_texture
            batch = draw_rays(data.scene.train, 64, generator, plain=plain).to(device)
            losses, _ = trial.compute_losses(batch, step_generator(0, Stream.STEP, 0, device))
            total_loss(losses).backward()
        elif isinstance(trial, NeRF2D):
            uv, rgb = torch.rand(64, 5, generator=step_generator(0, Stream.BATCH, 0)).to(device).split([2, 3], dim=1)
            trial.loss(PixelBatch(uv, rgb)).backward()


def report(results: dict, folder: Path, logger: L.pytorch.loggers.Logger | None) -> None:
    """Prints the outcome."""
    for one in results["recoveries"]:
        print(f"guard: at step {one['step']}: {one['cause']}; {one['action']}")
    scene, seconds = results["scene"]["name"], results["train_seconds"]
    quality = "no PSNR" if results["psnr"] is None else f"{results['psnr']:.2f} dB"
    quality += " held out"
    if (test := results["test"]) is not None and test["psnr"] is not None:
        of = "" if test["views"] == test["views_in_split"] else f" of {test['views_in_split']}"
        quality += f" (val), {test['psnr']:.2f} dB on {test['views']}{of} test views,"
    print(f"{scene}: {quality} after {seconds:.0f} s of training ({results['status']})")
    if (results["rows_measured"] or 1.0) < 1.0:
        share = f"{results['rows_measured']:.0%} of the rows of each held-out photo, to take no longer than training"
        print(f"measured on {share}; nerf_lightning evaluate {shlex.quote(str(folder))} measures all")
    if results["diagnosis"]:
        print(results["diagnosis"])
    crowded = crowding(results)
    if crowded is not None and crowded > CROWDED:
        print(f"the machine was busy with something else, which took {crowded:.0%} of this run's threads")
    with suppress(ValueError):  # a folder elsewhere is printed with its full path
        folder = folder.relative_to(Path.cwd())
    shown = isinstance(logger, L.pytorch.loggers.TensorBoardLogger)
    print(f"everything is in {folder}" + (f"; curves: tensorboard --logdir {folder.parent}" if shown else ""))
