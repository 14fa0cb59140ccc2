"""From configuration to objects. Nothing else in the package instantiates from a config."""

import copy
import inspect
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import lightning as L
import torch
from lightning.pytorch.loggers import Logger
from lightning.pytorch.strategies import SingleDeviceStrategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError

from nerf_lightning.callbacks import Budget, Evaluation
from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.config.limits import get_limits
from nerf_lightning.config.quoting import escape_interpolations
from nerf_lightning.datamodules import build_photo_data
from nerf_lightning.dataset import DataModule, PixelDataModule, RayDataModule
from nerf_lightning.dataset.resize import AUTO, compute_auto_resize
from nerf_lightning.errors import InputError
from nerf_lightning.model import Field, PictureField
from nerf_lightning.refine import Corrections
from nerf_lightning.renderer import VolumeRenderer
from nerf_lightning.renderer.background import Background
from nerf_lightning.sampler import Sampler
from nerf_lightning.system import NeRF2D, NeRF3D, System
from nerf_lightning.system.torch_compile import COMPILE_BACKEND
from nerf_lightning.utils.device import CPU, resolve_device
from nerf_lightning.utils.option_checks import check_options

LIGHTNING_DEVICES = ("cpu", "cuda", "mps")
"""Devices that Lightning knows; for any other it would silently take the CPU."""

SUPPORTED_PRECISIONS = ("32-true", "16-mixed", "bf16-mixed", 32, "32", 16, "16", "bf16")
"""Lightning's that training takes: the kernels, and what the renderer integrates, are in single precision."""


def instantiate_node(cfg: DictConfig, path: str, *kinds: type, **extra: Any) -> Any:
    """Builds what the node at `path` describes, passing `extra`; errors name the config's keys.

    Args:
        cfg: the whole configuration.
        path: of the node.
        kinds: classes, of one of which it must be.
        extra: what the target takes beside the node's options.

    Raises:
        InputError: where the key is missing, or its target refuses or does not know an option, or makes something else.
    """
    target, node = resolve_target(cfg, path), OmegaConf.select(cfg, path)
    missing = sorted(OmegaConf.missing_keys(node))
    if missing:
        raise InputError("config", missing[0], "missing", hint=f"give {missing[0]}=...")
    late = node.get("_partial_") or False
    check_options(path, target, get_options(node), extra, require_all=not late)
    # Hydra only binds the options: it would turn dataclasses among `extra` into configs.
    literal = escape_interpolations(
        escape_interpolations(resolve_config(node))
    )  # Hydra resolves what it is given twice
    bound = hydra.utils.instantiate(literal, _partial_=True, _convert_="all")
    try:
        # What Hydra binds it examines at every call, which a training step would pay for: once is enough.
        made = partial(bound.func, *bound.args, **{**bound.keywords, **extra}) if late else bound(**extra)
    except (ValueError, TypeError, MisconfigurationException) as error:
        if isinstance(error, InputError) or target.__module__.split(".")[0] == "nerf_lightning":
            raise  # our own targets raise InputError for bad options, so this is a defect
        raise InputError("config", path, f"{target.__name__} refuses its options: {error}") from error
    if kinds and not isinstance(made, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise InputError("config", f"{path}._target_", f"what makes a {type(made).__name__}", f"what makes a {wanted}")
    return made


def get_options(node: DictConfig) -> dict[str, Any]:
    """A node's options, without what is Hydra's."""
    return {key: value for key, value in resolve_config(node).items() if key not in ("_target_", "_partial_")}


def check_groups(cfg: DictConfig) -> None:
    """Checks the options of all groups by their targets' annotations, before photos are read or fetched.

    Raises:
        InputError: for an unknown option, and one of the wrong type or out of its bounds.
    """
    build_budget(cfg)
    groups = ["dataset", "model", "sampler", "renderer", "optimizer", "schedule", "refine", "logger", "trainer"]
    for path in [*groups, *(f"callbacks.{name}" for name in cfg.get("callbacks") or {})]:
        if isinstance(node := OmegaConf.select(cfg, path), DictConfig):
            check_options(path, resolve_target(cfg, path), get_options(node), require_all=False)


def resolve_target(cfg: DictConfig, path: str) -> Any:
    """The class or function that the node at `path` names.

    Raises:
        InputError: where it names none, or none that can be imported.
    """
    node = OmegaConf.select(cfg, path)
    if not isinstance(node, DictConfig):
        found = "nothing" if node is None else repr(node)
        raise InputError("config", path, found, f"one of the options of the group {path}", f"give {path}=NAME")
    try:
        return hydra.utils.get_object(node["_target_"])
    except (ImportError, AttributeError, ValueError, ConfigKeyError) as error:
        raise InputError("config", f"{path}._target_", f"cannot be imported: {error}") from error


def resolve_config(cfg: DictConfig) -> dict[str, Any]:
    """A configuration as plain containers, interpolations filled in."""
    plain = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(plain, dict)  # a DictConfig gives nothing else
    return {str(key): value for key, value in plain.items()}


def resolve_run_device(cfg: DictConfig) -> torch.device:
    """The device that a run asks for, by its trainer.

    Raises:
        InputError: where it is not there.
    """
    return resolve_device(str(OmegaConf.select(cfg, "trainer.accelerator", default="auto")))


def build_data(cfg: DictConfig, path: str | Path | None = None) -> DataModule:
    """The data module, with its scene loaded; `path` names other photos than the configuration does."""
    chosen = {}
    if cfg.dataset.get("resize") == AUTO:
        limits = build_budget(cfg)
        chosen["resize"] = compute_auto_resize(
            limits.max_seconds, limits.steps, resolve_run_device(cfg), torch.get_num_threads()
        )
    source = cfg if path is None else replace_photos(cfg, path)
    return instantiate_node(source, "dataset", RayDataModule, PixelDataModule, **chosen)


def replace_photos(cfg: DictConfig, path: str | Path) -> DictConfig:
    """A copy of a configuration that reads other photos: those at `path`, in place of a built-in scene too."""
    moved = copy.deepcopy(cfg)
    if "path" not in inspect.signature(resolve_target(cfg, "dataset")).parameters:
        shared = {
            key: value for key, value in cfg.dataset.items() if key in inspect.signature(build_photo_data).parameters
        }
        moved.dataset = {"_target_": "nerf_lightning.datamodules.build_photo_data", **shared}
    OmegaConf.update(moved, "dataset.path", escape_interpolations(str(path)), force_add=True)
    return moved


def build_field(cfg: DictConfig, kind: type, dimensions: str, **extra: Any) -> Any:
    """The field, if it has as many dimensions as the data."""
    found = resolve_target(cfg, "model") if cfg.get("model") is not None else None
    if not (inspect.isclass(found) and issubclass(found, kind)):
        name = getattr(found, "__name__", "nothing")
        advice = "model=hashgrid or model=mlp" if kind is Field else "model=hashgrid2d or model=picture_mlp"
        raise InputError("config", "model", name, f"a field of {dimensions} for this dataset", f"choose {advice}")
    return instantiate_node(cfg, "model", kind, **extra)


def build_system(cfg: DictConfig, frame: "Metadata", device: torch.device = CPU) -> System:
    """The LightningModule, NeRF3D for a scene's frame and NeRF2D for a picture's: on the CPU, with the limits of `device`."""
    optimizer = instantiate_node(cfg, "optimizer")
    try:
        optimizer([torch.zeros(1)])  # so that a negative rate is reported now, not when training starts
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise InputError("config", "optimizer", f"{cfg.optimizer._target_} refuses its options: {error}") from error
    chunk = get_limits(cfg, device).chunk_samples
    common = {"optimizer": optimizer, "schedule": instantiate_node(cfg, "schedule"), "seed": cfg.seed, "chunk": chunk}
    common["compile_backend"] = COMPILE_BACKEND if cfg.compile else None
    if isinstance(frame, ImageMetadata):
        return NeRF2D(build_field(cfg, PictureField, "two coordinates", size=(frame.width, frame.height)), **common)
    bounds = frame.bounds
    field = build_field(cfg, Field, "three coordinates", bounds=bounds)
    sampler = instantiate_node(cfg, "sampler", Sampler, bounds=bounds, chunk=chunk)
    seen = {"half_size": float(bounds.half_size.min()), "unbounded": bounds.unbounded, "alpha": frame.alpha}
    renderer = instantiate_node(cfg, "renderer", VolumeRenderer, scene_background=frame.background, **seen)
    corrections = None
    if frame.cameras is not None:
        check_background(cfg, frame, renderer.background)
        if cfg.get("refine") is not None:
            photographed = {"cameras": frame.cameras, "bounds": frame.bounds, "exposures": frame.exposures}
            corrections = instantiate_node(cfg, "refine", Corrections, **photographed)
    return NeRF3D(field, sampler, renderer, **common, corrections=corrections)


def check_background(cfg: DictConfig, frame: "SceneMetadata", background: Background) -> None:
    """Photos without alpha show one background colour; with another, the field would learn that colour as a wall."""
    is_same = torch.allclose(background.color, torch.tensor(frame.background), atol=1e-3)
    if not frame.alpha and (background.is_random or not is_same):
        expected = f"scene: the photos have no alpha and stand on {[round(c, 3) for c in frame.background]}"
        raise InputError("config: renderer.background", "", str(cfg.renderer.background), expected)


def has_pose_refinement(cfg: DictConfig) -> bool:
    """Whether training corrects the poses, or may."""
    return bool((cfg.get("refine") or {}).get("poses"))


@dataclass(frozen=True)
class SceneMetadata:
    """What a 3D system takes from its scene: where it is, and the colour behind it."""

    bounds: Bounds
    background: tuple[float, float, float]
    cameras: Cameras | None = None
    """Of the training photos; None where there is nothing to train."""
    alpha: bool = False
    """Whether they have alpha."""
    exposures: tuple[float, ...] = ()
    """Light that they gathered, see `Views`."""


@dataclass(frozen=True)
class ImageMetadata:
    """What a 2D system takes from its picture: pixels along each side."""

    width: int
    height: int


Metadata = SceneMetadata | ImageMetadata


def get_metadata(data: DataModule) -> Metadata:
    """What a system takes from the data."""
    if isinstance(data, PixelDataModule):
        return ImageMetadata(*data.scene.size)
    bounds, train = data.scene.bounds, data.scene.train
    pixel_footprint = train.cameras.pixel_footprint(bounds.centre)
    seen = train.cameras, train.channels == 4, train.exposures
    return SceneMetadata(replace(bounds, pixel_footprint=pixel_footprint or None), data.scene.background, *seen)


def get_budget_options(cfg: DictConfig) -> dict[str, Any]:
    """The user's limits, or the experiment's own if the user gives none."""
    budget = resolve_config(cfg.budget)
    default = budget.pop("default") if isinstance(budget.get("default"), dict) else {}
    return budget if any(budget.get(key) is not None for key in default) else {**budget, **default}


def build_budget(cfg: DictConfig) -> Budget:
    """How long to train."""
    limits = get_budget_options(cfg)
    check_options("budget", Budget, limits)
    return Budget(**limits)


def build_trainer(cfg: DictConfig, folder: Path, device: torch.device) -> L.Trainer:
    """The Trainer with its callbacks, on a device, writing into `folder`."""
    logger = instantiate_node(cfg, "logger", Logger, save_dir=folder) if cfg.get("logger") is not None else False
    chosen = [name for name, node in (cfg.get("callbacks") or {}).items() if node is not None]
    callbacks = [instantiate_node(cfg, f"callbacks.{name}", L.Callback) for name in chosen]
    # The budget comes first, as the others read its clock, and figures come before pictures.
    callbacks = [build_budget(cfg), Evaluation(), *callbacks]
    precision = OmegaConf.select(cfg, "trainer.precision")
    if precision not in (None, *SUPPORTED_PRECISIONS):
        raise InputError(
            "config", "trainer.precision", repr(precision), f"one of {', '.join(map(str, SUPPORTED_PRECISIONS))}"
        )
    where: dict[str, Any] = {"accelerator": device.type, "enable_checkpointing": False}  # callbacks/checkpoints does it
    if device.type not in LIGHTNING_DEVICES:
        where["strategy"] = SingleDeviceStrategy(device)
    return instantiate_node(
        cfg, "trainer", L.Trainer, callbacks=callbacks, logger=logger, default_root_dir=folder, **where
    )
