"""Process setup before training: threads, kernels, seed and warm-up."""

import copy
from contextlib import nullcontext

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from rich.console import Console

from nerf_lightning.dataset import DataModule
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import set_kernels
from nerf_lightning.system import System
from nerf_lightning.utils.memory import keep_freed_memory
from nerf_lightning.utils.progress import is_interactive


def prepare_process(cfg: DictConfig) -> None:
    """Sets process-wide state.

    Raises:
        InputError: for unknown kernels.
    """
    if cfg.threads is not None:
        torch.set_num_threads(cfg.threads)
    set_kernels(cfg.kernels)
    keep_freed_memory()
    torch.set_flush_denormal(True)  # tiny weights otherwise slow the CPU down many times
    L.seed_everything(cfg.seed, verbose=False)


def check_processes(trainer: L.Trainer) -> None:
    """Checks that the trainer's processes can share the run.

    Raises:
        InputError: for a sweep whose jobs would start further processes.
    """
    if trainer.world_size == 1:
        return
    cluster = getattr(trainer.strategy, "cluster_environment", None)
    if HydraConfig.get().mode == RunMode.MULTIRUN and not getattr(cluster, "creates_processes_externally", False):
        hint = "or a launcher that starts the processes itself"
        raise InputError("config", "trainer.devices", str(trainer.world_size), "one process a job in a sweep", hint)


def warm_up(system: System, data: DataModule, device: torch.device) -> None:
    """Runs a small step on a copy, so that kernels are compiled before the clock starts.

    CPU and GPU kernels are compiled once and cached.
    """
    note = " (compiled on first use: half a minute)" if device.type in ("cpu", "cuda") else ""
    console = Console()
    with console.status(f"preparing kernels{note}") if is_interactive(console) else nullcontext():
        copy.deepcopy(system).to(device).warm_up_kernels(data.make_warmup_batch())
