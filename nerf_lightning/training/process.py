"""What training sets and checks in its process before the clock starts."""

import copy
from contextlib import nullcontext

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from rich.console import Console

from nerf_lightning.dataset import PixelBatch, PixelDataModule, RayDataModule
from nerf_lightning.dataset.rays import make_batch
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import use_kernels
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.system.system import total_loss
from nerf_lightning.utils.memory import keep_freed_memory
from nerf_lightning.utils.progress import animates
from nerf_lightning.utils.seeding import Stream, step_generator


def prepare_process(cfg: DictConfig, may_compile: bool = False) -> None:
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
    is_compiled = device.type == "cpu" or system.backend is not None
    note = " (the first time they are compiled: half a minute)" if is_compiled else ""
    console = Console()
    with console.status(f"getting the kernels ready{note}") if animates(console) else nullcontext():
        trial, generator = copy.deepcopy(system).to(device), step_generator(0, Stream.BATCH, 0)
        if isinstance(trial, NeRF3D):
            assert isinstance(data, RayDataModule)  # what build_system makes a NeRF3D for
            photos, with_texture = data.scene.train, trial.renderer.uses_texture
            batch = make_batch(photos, photos.draw(64, generator), with_texture).to(device)
            losses, _ = trial.compute_losses(batch, step_generator(0, Stream.STEP, 0, device))
            total_loss(losses).backward()
        else:
            uv, rgb = torch.rand(64, 5, generator=generator).to(device).split([2, 3], dim=1)
            trial.loss(PixelBatch(uv, rgb)).backward()  # type: ignore[operator]  # a NeRF2D's
