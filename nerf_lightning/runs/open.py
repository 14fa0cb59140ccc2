"""Opening runs: a folder or a compact file."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import set_kernels
from nerf_lightning.runs.compact import load_compact
from nerf_lightning.runs.folder import LoadedRun, load_run
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.libraries import silence_lightning


@dataclass(frozen=True)
class LoadedSceneRun(LoadedRun):
    """A loaded run of a 3D scene."""

    system: NeRF3D
    orbit: Cameras
    to_source: Float[Tensor, "4 4"]

    @property
    def scale(self) -> float:
        """Length of a world unit in the dataset's frame."""
        return float(torch.linalg.det(self.to_source[:3, :3])) ** (1 / 3)


def open_run(path: Path, device: torch.device) -> LoadedRun:
    """Loads a run, ready to render with the kernels it was trained with.

    Raises:
        InputError: the run is missing, damaged, of another version, or names an untrusted class.
    """
    silence_lightning()
    run = load_compact(path, device) if path.suffix == ".npz" else load_run(path, device=device)
    set_kernels(run.cfg.kernels)
    return run


def open_scene_run(path: Path, device: torch.device) -> LoadedSceneRun:
    """As `open_run`, for a 3D scene.

    Raises:
        InputError: also for the run of an image.
    """
    run = open_run(path, device)
    if run.orbit is None:
        raise InputError(path, "", "the run of an image", "the run of a scene", "see its final.png")
    return LoadedSceneRun(**vars(run))


def get_output_folder(path: Path) -> Path:
    """Default output folder of a run: its folder, or the parent of its compact file."""
    return path.parent if path.suffix == ".npz" else path
