"""The run folder: what a run writes, and how it is read back without trusting it.

config.yaml            the resolved configuration
scene.json             bounds, background and orbit of the scene, so that rendering needs no photos; corrected cameras
checkpoints/           last.ckpt, best.ckpt: tensors and plain values only
results.json           see callbacks/results.py
snapshots/ orbit.gif   pictures
"""

import json
import os
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.config.build import Frame, PictureFrame, SceneFrame, build_system, frame_of, resolved
from nerf_lightning.dataset import BUILT_IN, PixelDataModule, RayDataModule, Scene
from nerf_lightning.errors import InputError
from nerf_lightning.runs.trusted import check_config
from nerf_lightning.system import System
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.files import atomic, write_json

FORMAT = 1
"""Version of run folders. Goes up when older versions of this package can no longer read newer runs."""
GROUPS = ("dataset", "model", "optimizer", "schedule", "trainer")
"""Groups of a configuration, in the order written: if a file was cut short, at least the last is missing."""


def plain_config(cfg: DictConfig) -> dict[str, Any]:
    """The resolved configuration; a relative dataset path becomes absolute, so that it is valid from any folder."""
    plain = {key: value for key, value in resolved(cfg).items() if key != "overwrite"}  # of the command, not of the run
    path = plain["dataset"].get("path")
    if path is not None:
        plain["dataset"]["path"] = os.path.abspath(path)
    return plain


def save_config(cfg: DictConfig, folder: Path) -> None:
    """Writes the resolved configuration."""
    with atomic(folder / "config.yaml") as temporary:
        temporary.write_text(yaml.safe_dump(plain_config(cfg), sort_keys=False), encoding="utf-8")


def load_config(folder: Path) -> DictConfig:
    """Reads a run's configuration; refuses anything that would run code from outside the package.

    Raises:
        InputError: if the file is missing, broken or cut short, holds interpolations, or names a target that is not trusted.
    """
    path = folder / "config.yaml"
    try:
        plain = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(path, "", "no such file", "the folder of a run", "look below outputs/") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(path, "", str(error), "a run's configuration in YAML") from error
    checked = check_config(plain, path)
    missing = [group for group in GROUPS if group not in checked]
    if missing:
        raise InputError(path, missing[0], "nothing", "a run's whole configuration", "was the file cut short?")
    return OmegaConf.create(checked)


def save_scene(
    data: RayDataModule | PixelDataModule,
    folder: Path,
    corrected: Cameras | None = None,
    focal_factor: float | None = None,
) -> None:
    """Writes what rendering needs of the scene, without its photos, and the training cameras if training has corrected them,
    perhaps with a factor on their focal length."""
    content = scene_content(data)
    if corrected is not None:
        content |= {"corrected": corrected.c2w.tolist(), "focal_factor": focal_factor}
    write_json(folder / "scene.json", content)


def scene_content(data: RayDataModule | PixelDataModule) -> dict[str, Any]:
    """The same as plain values."""
    scene, frame = data.scene, frame_of(data)
    content: dict[str, Any] = {"format": FORMAT, **scene.describe()}
    if scene.source != BUILT_IN:
        content["source"] = os.path.abspath(scene.source)
    if isinstance(scene, Scene) and isinstance(frame, SceneFrame):
        content |= {
            "background": list(frame.background),
            "aabb": frame.bounds.aabb.tolist(),
            "unbounded": frame.bounds.unbounded,
            "near": frame.bounds.near,
            "far": frame.bounds.far,
            "pixel": frame.bounds.pixel,
            "to_source": scene.to_source.tolist(),
            "orbit": {
                "K": scene.orbit.K.tolist(),
                "c2w": scene.orbit.c2w.tolist(),
                "width": scene.orbit.width,
                "height": scene.orbit.height,
            },
        }
    return content


@dataclass(frozen=True)
class RunFolder:
    """A run read back, ready to render."""

    cfg: DictConfig
    system: System
    orbit: Cameras | None
    """None for a picture."""
    to_source: Float[Tensor, "4 4"] | None
    """Similarity transform from the world frame to that of the photos' file; None for a picture."""
    scene: dict[str, Any]
    """The content of scene.json."""


def frame_from(scene: dict[str, Any]) -> tuple[Frame, Cameras | None, Tensor | None]:
    """Reads what `scene_content` wrote: a system's frame, the orbit, and the transform to the source; None for a picture.

    Raises:
        ValueError, KeyError, TypeError: if it is incomplete.
    """
    if "aabb" not in scene:
        return PictureFrame(*map(int, scene["resolution"])), None, None
    near, far, pixel = scene["near"], scene["far"], scene.get("pixel")
    bounds = Bounds(torch.tensor(scene["aabb"]), scene["unbounded"], near, far, pixel)
    red, green, blue = map(float, scene["background"])
    view = scene["orbit"]
    orbit = Cameras.of_size(torch.tensor(view["K"]), torch.tensor(view["c2w"]), view["width"], view["height"])
    to_source = torch.tensor(scene["to_source"], dtype=torch.float32).view(4, 4)
    return SceneFrame(bounds, (red, green, blue)), orbit, to_source


def load_run(folder: Path, checkpoint: str = "last.ckpt", device: torch.device = CPU) -> RunFolder:
    """Rebuilds a trained system from its folder alone, on a device.

    Raises:
        InputError: if a file is missing, broken, or does not match the others.
    """
    cfg = load_config(folder)
    scene, (frame, orbit, to_source) = load_scene(folder)
    system = build_system(cfg, frame, device)
    state = read_checkpoint(folder / "checkpoints" / checkpoint)
    try:
        # Corrections are of training photos, which rendering has none of.
        weights = {key: value for key, value in state["state_dict"].items() if not key.startswith("corrections.")}
        system.load_state_dict(weights)
    except (KeyError, RuntimeError) as error:
        raise InputError(
            folder / "checkpoints" / checkpoint, "state_dict", str(error), "the weights of this run's model"
        ) from error
    return RunFolder(cfg, system.eval().to(device), orbit, to_source, scene)


def load_scene(folder: Path) -> tuple[dict[str, Any], tuple[Frame, Cameras | None, Tensor | None]]:
    """The content of a run's scene.json, and what `frame_from` makes of it.

    Raises:
        InputError: where it is missing, broken, or of another version.
    """
    path = folder / "scene.json"
    try:
        scene = json.loads(path.read_text(encoding="utf-8"))
        if scene.get("format", FORMAT) != FORMAT:
            found, expected = f"format {scene['format']}", f"format {FORMAT}, which this version reads"
            raise InputError(path, "format", found, expected, "use the version of nerf_lightning that made the run")
        return scene, frame_from(scene)
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(path, "", "no such file", "the scene of a run") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise InputError(path, "", f"{type(error).__name__}: {error}", "the scene of a run, whole") from error


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Reads a checkpoint: tensors and plain values, never code.

    Raises:
        InputError: where the file is missing, truncated, or holds anything else.
    """
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(
            path, "", "no such file", "a checkpoint", "the run may have ended before its first one"
        ) from error
    except (OSError, EOFError, RuntimeError, pickle.UnpicklingError) as error:
        raise InputError(
            path, "", str(error).split(".")[0], "a whole checkpoint of tensors and plain values"
        ) from error
