"""Opens a run by its path: a folder, or the compact file made from one."""

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
    """As `LoadedRun`, for a scene."""

    system: NeRF3D
    orbit: Cameras
    to_source: Float[Tensor, "4 4"]

    @property
    def scale(self) -> float:
        """Length of a world unit in the frame of the photos' own file."""
        return float(torch.linalg.det(self.to_source[:3, :3])) ** (1 / 3)


def open_run(path: Path, device: torch.device) -> LoadedRun:
    """Reads a trained system, ready to render on a device with the kernels it was trained with.

    Raises:
        InputError: if there is none, or it is broken, of another version, or names something not trusted.
    """
    silence_lightning()
    found = load_compact(path, device) if path.suffix == ".npz" else load_run(path, device=device)
    set_kernels(found.cfg.kernels)
    return found


def open_scene_run(path: Path, device: torch.device) -> LoadedSceneRun:
    """As `open_run`, of a scene.

    Raises:
        InputError: as there, and for a picture's run.
    """
    found = open_run(path, device)
    if found.orbit is None:
        raise InputError(path, "", "a picture's run", "a scene's run", "final.png shows a picture")
    return LoadedSceneRun(**vars(found))


def get_output_folder(path: Path) -> Path:
    """Where to write what is made from a run: its folder, or the one its compact file is in."""
    return path.parent if path.suffix == ".npz" else path
