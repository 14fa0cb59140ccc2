"""Builds objects from a configuration. Nothing else in the package instantiates from a config."""

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
from nerf_lightning.utils.device import CPU, resolve_device
from nerf_lightning.utils.option_checks import check_options

LIGHTNING_DEVICES = ("cpu", "cuda", "mps")
"""Devices that Lightning supports; for any other it would silently take the CPU."""

PRECISIONS = ("32-true", "16-mixed", "bf16-mixed", 32, "32", 16, "16", "bf16")
"""Lightning precisions that training supports: kernels and volume rendering stay in float32."""


def instantiate_node(cfg: DictConfig, path: str, *kinds: type, **extra: Any) -> Any:
    """Instantiates the node at `path` with `extra` arguments; errors name the config's keys.

    Args:
        cfg: the whole configuration.
        path: of the node.
        kinds: classes, of one of which the result must be.
        extra: arguments of the target besides the node's options.

    Raises:
        InputError: if the node is missing, its target rejects or does not know an option, or the result is of another class.
    """
    target, node = resolve_target(cfg, path), OmegaConf.select(cfg, path)
    missing = sorted(OmegaConf.missing_keys(node))
    if missing:
        raise InputError("config", missing[0], "missing", hint=f"give {missing[0]}=...")
    is_partial = node.get("_partial_") or False
    check_options(path, target, get_options(node), extra, require_all=not is_partial)
    # Hydra, which resolves its input twice, only binds the options: it would turn dataclasses among `extra` into configs.
    literal = escape_interpolations(escape_interpolations(resolve_config(node)))
    bound = hydra.utils.instantiate(literal, _partial_=True, _convert_="all")
    try:
        # A plain partial, as Hydra's examines its arguments at every call, in every training step.
        result = partial(bound.func, *bound.args, **{**bound.keywords, **extra}) if is_partial else bound(**extra)
    except (ValueError, TypeError, MisconfigurationException) as error:
        if isinstance(error, InputError) or target.__module__.split(".")[0] == "nerf_lightning":
            raise  # our own targets raise InputError for bad options, so this is a defect
        raise InputError("config", path, f"{target.__name__} refuses its options: {error}") from error
    if kinds and not isinstance(result, kinds):
        expected = f"what makes a {' or '.join(kind.__name__ for kind in kinds)}"
        raise InputError("config", f"{path}._target_", f"what makes a {type(result).__name__}", expected)
    return result


def get_options(node: DictConfig) -> dict[str, Any]:
    """Options of a node, without Hydra's keys."""
    return {key: value for key, value in resolve_config(node).items() if key not in ("_target_", "_partial_")}


def check_groups(cfg: DictConfig) -> None:
    """Checks the options of all groups by their targets' annotations, before photos are read or downloaded.

    Raises:
        InputError: for an unknown option, a wrong type, and a value out of bounds.
    """
    build_budget(cfg)
    groups = ["dataset", "model", "sampler", "renderer", "optimizer", "schedule", "refine", "logger", "trainer"]
    for path in [*groups, *(f"callbacks.{name}" for name in cfg.get("callbacks") or {})]:
        if isinstance(node := OmegaConf.select(cfg, path), DictConfig):
            check_options(path, resolve_target(cfg, path), get_options(node), require_all=False)


def resolve_target(cfg: DictConfig, path: str) -> Any:
    """Class or function that the node at `path` names.

    Raises:
        InputError: if it names none, or none that can be imported.
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
    """Configuration as plain containers, with interpolations resolved."""
    plain = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(plain, dict)  # of a DictConfig
    return {str(key): value for key, value in plain.items()}


def resolve_run_device(cfg: DictConfig) -> torch.device:
    """Device of a run, by its trainer's accelerator.

    Raises:
        InputError: if it is not available.
    """
    return resolve_device(str(OmegaConf.select(cfg, "trainer.accelerator", default="auto")))


def build_data(cfg: DictConfig, path: str | Path | None = None) -> DataModule:
    """Builds the data module and loads its scene; `path` replaces the configuration's photos."""
    overrides = {}
    if cfg.dataset.get("resize") == AUTO:
        limits = build_budget(cfg)
        device, threads = resolve_run_device(cfg), torch.get_num_threads()
        overrides["resize"] = compute_auto_resize(limits.max_seconds, limits.steps, device, threads)
    source = cfg if path is None else replace_photos(cfg, path)
    return instantiate_node(source, "dataset", RayDataModule, PixelDataModule, **overrides)


def replace_photos(cfg: DictConfig, path: str | Path) -> DictConfig:
    """Copies a configuration with the photos at `path`, in place of a built-in scene too."""
    new_cfg = copy.deepcopy(cfg)
    if "path" not in inspect.signature(resolve_target(cfg, "dataset")).parameters:
        accepted = inspect.signature(build_photo_data).parameters
        photo_options = {key: value for key, value in cfg.dataset.items() if key in accepted}
        new_cfg.dataset = {"_target_": "nerf_lightning.datamodules.build_photo_data", **photo_options}
    OmegaConf.update(new_cfg, "dataset.path", escape_interpolations(str(path)), force_add=True)
    return new_cfg


def build_field(cfg: DictConfig, kind: type, dimensions: str, **extra: Any) -> Any:
    """Builds the field, if it has the dimensions of the data."""
    target = resolve_target(cfg, "model") if cfg.get("model") is not None else None
    if not (inspect.isclass(target) and issubclass(target, kind)):
        name = getattr(target, "__name__", "nothing")
        hint = "model=hashgrid or model=mlp" if kind is Field else "model=hashgrid2d or model=picture_mlp"
        raise InputError("config", "model", name, f"a field of {dimensions} for this dataset", f"choose {hint}")
    return instantiate_node(cfg, "model", kind, **extra)


def build_system(cfg: DictConfig, metadata: "Metadata", device: torch.device = CPU) -> System:
    """Builds NeRF3D for a scene's metadata and NeRF2D for an image's, on the CPU, with the limits of `device`."""
    optimizer = instantiate_node(cfg, "optimizer")
    try:
        optimizer([torch.zeros(1)])  # so that a negative rate is reported now, not when training starts
    except (ArithmeticError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise InputError("config", "optimizer", f"{cfg.optimizer._target_} refuses its options: {error}") from error
    chunk = get_limits(cfg, device).chunk_samples
    common = {"optimizer": optimizer, "schedule": instantiate_node(cfg, "schedule"), "seed": cfg.seed, "chunk": chunk}
    if isinstance(metadata, ImageMetadata):
        size = metadata.width, metadata.height
        return NeRF2D(build_field(cfg, PictureField, "two coordinates", size=size), **common)
    bounds = metadata.bounds
    field = build_field(cfg, Field, "three coordinates", bounds=bounds)
    sampler = instantiate_node(cfg, "sampler", Sampler, bounds=bounds, chunk=chunk)
    scene = {"half_size": float(bounds.half_size.min()), "unbounded": bounds.unbounded, "alpha": metadata.alpha}
    renderer = instantiate_node(cfg, "renderer", VolumeRenderer, scene_background=metadata.background, **scene)
    corrections = None
    if metadata.cameras is not None:
        check_background(cfg, metadata, renderer.background)
        if cfg.get("refine") is not None:
            photos = {"cameras": metadata.cameras, "bounds": metadata.bounds, "exposures": metadata.exposures}
            corrections = instantiate_node(cfg, "refine", Corrections, **photos)
    return NeRF3D(field, sampler, renderer, **common, corrections=corrections)


def check_background(cfg: DictConfig, metadata: "SceneMetadata", background: Background) -> None:
    """Rejects another background than that of photos without alpha: the field would learn theirs as a wall."""
    is_same = torch.allclose(background.color, torch.tensor(metadata.background), atol=1e-3)
    if not metadata.alpha and (background.is_random or not is_same):
        expected = f"scene: the photos have no alpha and stand on {[round(c, 3) for c in metadata.background]}"
        raise InputError("config: renderer.background", "", str(cfg.renderer.background), expected)


def has_pose_refinement(cfg: DictConfig) -> bool:
    """Whether training refines the poses, or may."""
    return bool((cfg.get("refine") or {}).get("poses"))


@dataclass(frozen=True)
class SceneMetadata:
    """Metadata of a scene that a 3D system needs."""

    bounds: Bounds
    background: tuple[float, float, float]
    cameras: Cameras | None = None
    """Training cameras; None where there is nothing to train."""
    alpha: bool = False
    """Whether the photos have alpha."""
    exposures: tuple[float, ...] = ()
    """Exposures of the photos, see `Views`."""


@dataclass(frozen=True)
class ImageMetadata:
    """Image size in pixels, for a 2D system."""

    width: int
    height: int


Metadata = SceneMetadata | ImageMetadata


def get_metadata(data: DataModule) -> Metadata:
    """Metadata of the data, for `build_system`."""
    if isinstance(data, PixelDataModule):
        return ImageMetadata(*data.scene.size)
    bounds, train = data.scene.bounds, data.scene.train
    pixel_footprint = train.cameras.pixel_footprint(bounds.center)
    photos = train.cameras, train.channels == 4, train.exposures
    return SceneMetadata(replace(bounds, pixel_footprint=pixel_footprint or None), data.scene.background, *photos)


def get_budget_options(cfg: DictConfig) -> dict[str, Any]:
    """Budget limits of the user, or the experiment's defaults without any."""
    budget = resolve_config(cfg.budget)
    default = budget.pop("default") if isinstance(budget.get("default"), dict) else {}
    return budget if any(budget.get(key) is not None for key in default) else {**budget, **default}


def build_budget(cfg: DictConfig) -> Budget:
    limits = get_budget_options(cfg)
    check_options("budget", Budget, limits)
    return Budget(**limits)


def build_trainer(cfg: DictConfig, folder: Path, device: torch.device) -> L.Trainer:
    """Builds the Trainer and its callbacks, which write into `folder`."""
    logger = instantiate_node(cfg, "logger", Logger, save_dir=folder) if cfg.get("logger") is not None else False
    names = [name for name, node in (cfg.get("callbacks") or {}).items() if node is not None]
    callbacks = [instantiate_node(cfg, f"callbacks.{name}", L.Callback) for name in names]
    # The budget comes first, as the others read its clock, and metrics come before images.
    callbacks = [build_budget(cfg), Evaluation(), *callbacks]
    precision = OmegaConf.select(cfg, "trainer.precision")
    if precision not in (None, *PRECISIONS):
        raise InputError("config", "trainer.precision", repr(precision), f"one of {', '.join(map(str, PRECISIONS))}")
    # Checkpoints are written by callbacks/checkpoints.
    options: dict[str, Any] = {"accelerator": device.type, "enable_checkpointing": False, "default_root_dir": folder}
    if device.type not in LIGHTNING_DEVICES:
        options["strategy"] = SingleDeviceStrategy(device)
    return instantiate_node(cfg, "trainer", L.Trainer, callbacks=callbacks, logger=logger, **options)
