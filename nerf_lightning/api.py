"""Python API: scenes, training and runs, with the command line's defaults."""

import functools
import math
import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch
from hydra.core.hydra_config import HydraConfig
from jaxtyping import Float
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.cli import export as commands
from nerf_lightning.cli.compare import compare
from nerf_lightning.cli.evaluate import evaluate
from nerf_lightning.cli.render import render as render_run
from nerf_lightning.cli.rightsize import rightsize
from nerf_lightning.cli.view import view
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.quoting import make_override
from nerf_lightning.dataset import PhotoLoadOptions, Scene, open_scene
from nerf_lightning.dataset.resize import AUTO, compute_auto_resize
from nerf_lightning.kernels.backend import get_kernels, set_kernels
from nerf_lightning.runs.open import open_scene_run
from nerf_lightning.runs.run_lock import RunFolderInUse, lock_new_run_folder
from nerf_lightning.runs.summaries import read_run
from nerf_lightning.system import NeRF3D
from nerf_lightning.training.train import train as train_configured
from nerf_lightning.utils.device import resolve_device
from nerf_lightning.utils.files import expand_user_path
from nerf_lightning.utils.signals import SignalInterrupt, handle_signals

__all__ = ["Run", "View", "compare", "load_run", "load_scene", "rightsize", "train"]
P = ParamSpec("P")
T = TypeVar("T")


def _make_method(function: Callable[P, T]) -> Callable[P, T]:
    """Makes a command a method on the run's path, with the same options; it preserves the process state."""

    @functools.wraps(function)
    def method(self: "Run | Exports", *args: Any, **kwargs: Any) -> T:
        with preserve_process_state():
            return function(self.path, *args, **kwargs)  # type: ignore[arg-type]

    return method  # type: ignore[return-value]


@dataclass(frozen=True)
class View:
    """A rendered view on the run's background."""

    rgb: Float[Tensor, "H W 3"]
    """Colors in [0, 1]."""
    opacity: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"]
    """Mean distance along the ray, in scene units."""


@dataclass(frozen=True)
class Run:
    """A trained run, ready to render."""

    path: Path
    """Run folder, or compact file."""
    system: NeRF3D
    orbit: Cameras
    """Camera path for videos."""
    results: dict[str, Any]
    """Content of results.json; empty for a compact file."""

    @property
    def psnr(self) -> float:
        """Mean PSNR of the held-out views in dB; nan if not measured."""
        psnr = self.results.get("psnr")
        return math.nan if psnr is None else float(psnr)

    def render(self, camera: Cameras) -> View:
        """Renders the first of the cameras, for example `scene.val.cameras[0]`; the result is on the CPU."""
        output = self.system.render(camera.generate_view_rays(0).to(self.system.device), width=camera.width)
        shape = (camera.height, camera.width)
        rgb, opacity, depth = (x.cpu() for x in (output.rgb, output.opacity, output.depth))
        return View(rgb.clamp(0, 1).view(*shape, 3), opacity.view(shape), depth.view(shape))

    evaluate = _make_method(evaluate)
    render_video = _make_method(render_run)
    view = _make_method(view)

    @property
    def export(self) -> "Exports":
        """Exports the run to a file: `run.export.mesh(output="lego.glb")`, as `nerf_lightning export mesh` does."""
        return Exports(self.path)


@dataclass(frozen=True)
class Exports:
    """Sub-commands of `nerf_lightning export`, for one run."""

    path: Path

    compact = _make_method(commands.export_compact)
    html = _make_method(commands.export_html)
    mesh = _make_method(commands.export_mesh)
    points = _make_method(commands.export_points)
    transforms = _make_method(commands.export_transforms)
    voxels = _make_method(commands.export_voxels)


def load_scene(path: str | Path, resize: int | str | None = AUTO) -> Scene:
    """Loads a scene in any format that the command line takes.

    Args:
        path: a scene of any format in `docs/photos.md`, a folder of photos, or a video.
        resize: longest side in pixels; larger photos are downsampled. "auto": what 90 s of training on this machine's CPU can
            use, 800 pixels at least; None keeps the size.

    Raises:
        InputError: if it does not exist or is damaged.
    """
    return open_scene(os.path.abspath(expand_user_path(path)), options=PhotoLoadOptions(resize))


def load_run(path: str | Path, device: str = "auto") -> Run:
    """Opens a scene's run by its folder or its compact file; nothing in it is executed.

    Args:
        path: of the folder or file.
        device: to render on: auto, cpu, cuda or mps.

    Raises:
        InputError: if it does not exist, is damaged or a picture's, or the device is not available.
    """
    run_path = expand_user_path(path)
    with preserve_process_state():
        opened = open_scene_run(run_path, resolve_device(device))
    return Run(run_path, opened.system, opened.orbit, read_run(run_path).results if run_path.is_dir() else {})


def train(
    scene: Scene | str | Path,
    recipe: str | None = None,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    device: str = "auto",
    folder: str | Path | None = None,
    options: Sequence[str] = (),
) -> Run:
    """Trains as `nerf_lightning train dataset=photos dataset.path=SCENE` does, with the same defaults and results.

    Args:
        scene: from `load_scene`, or its path, whose photos are then read at the size that fits the budget.
        recipe: model with matching settings, such as tensorf_medium; None for the command line's default.
        seconds, steps: length of the training; with both, whichever ends first; without either, 90 seconds.
        seed: of weights, batches and jitter: the same seed, threads and steps give the same weights.
        device: auto, cpu, cuda or mps.
        folder: of the run, locked while it trains; None creates one in outputs/, named after the scene and the time.
        options: further overrides of the command line, such as ["renderer.background=white", "model.width=64"].

    Raises:
        InputError: as the command line does, in one line.
        FileExistsError: if the folder holds a run (options=["overwrite=true"] replaces it), or is in use by one.
        KeyboardInterrupt: after Ctrl-C; the last state is saved, and the command line's `resume=` continues from it.
    """
    if isinstance(scene, str | Path):
        size = compute_auto_resize(seconds, steps, resolve_device(device), torch.get_num_threads())
        scene = open_scene(os.path.abspath(expand_user_path(scene)), options=PhotoLoadOptions(size))
    default_path = Path("outputs", scene.name, datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
    run_path = default_path if folder is None else expand_user_path(folder)
    overrides = [
        "dataset=photos",
        make_override("dataset.path", scene.source),
        f"dataset.resize={scene.train.cameras.max_side}",
        make_override("name", scene.name),
        f"seed={seed}",
        f"device={device}",
        f"budget.seconds={'null' if seconds is None else seconds}",
        f"budget.steps={'null' if steps is None else steps}",
        *([] if recipe is None else [f"recipe={recipe}"]),
    ]
    try:
        with preserve_process_state(), handle_signals():
            cfg = compose_config([*overrides, *options], run_path)
            with lock_new_run_folder(run_path, cfg.overwrite, allow_suffix=folder is None) as run_path:
                train_configured(cfg, folder=run_path, scene=scene)
    except RunFolderInUse as error:
        raise FileExistsError(f"{error}; load_run opens it, another folder= keeps both") from error
    except SignalInterrupt as interrupt:
        signal.raise_signal(interrupt.signum)  # to the caller's own handlers
        raise
    return load_run(run_path, device)


@contextmanager
def preserve_process_state() -> Iterator[None]:
    """Restores the process state on exit: random state, threads, kernels, denormals, warnings, Hydra."""
    hydra, threads, kernels = HydraConfig.instance().cfg, torch.get_num_threads(), get_kernels()
    flushes_denormals = float(torch.tensor(1e-40) * 1) == 0
    try:
        with warnings.catch_warnings(), isolate_rng():
            yield
    finally:
        HydraConfig.instance().cfg = hydra
        torch.set_num_threads(threads)
        set_kernels(kernels)
        torch.set_flush_denormal(flushes_denormals)
