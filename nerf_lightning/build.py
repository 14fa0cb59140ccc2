"""From configuration to objects. Nothing else in the package instantiates from a config."""

from functools import partial
from pathlib import Path
from typing import Any

import hydra
import lightning as L
from hydra.errors import InstantiationException
from lightning.pytorch.loggers import Logger
from omegaconf import DictConfig

from nerf_lightning.callbacks import Budget, Results
from nerf_lightning.cameras import Bounds
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.errors import InputError
from nerf_lightning.model import Field, PictureField
from nerf_lightning.system import NeRF2D, NeRF3D, System


def make(cfg: DictConfig, key: str, **extra: Any) -> Any:
    """Instantiates `cfg[key]`, passing `extra`; the reasons it cannot be are told in terms of the config.

    Raises:
        InputError: where the key is missing, or its target refuses or does not know an option.
    """
    if cfg.get(key) is None:
        raise InputError("config", key, "nothing", f"one of the options of the group {key}", f"give {key}=NAME")
    try:
        # Hydra would turn dataclasses among `extra` into configs: it only binds the options, the call is ours.
        bound = hydra.utils.instantiate(cfg[key], _partial_=True)
        return partial(bound, **extra) if cfg[key].get("_partial_") else bound(**extra)
    except InstantiationException as error:
        raise InputError("config", key, str(error), "options that can be built") from error
    except TypeError as error:
        if "argument" not in str(error):  # a defect inside the target, not a call that does not fit it
            raise
        raise InputError("config", key, str(error), f"the options of {cfg[key]._target_}") from error


def build_data(cfg: DictConfig) -> RayDataModule | PixelDataModule:
    """The data module, its scene loaded."""
    return make(cfg, "dataset")


def build_field(cfg: DictConfig, kind: type, dimensions: str, **extra: Any) -> Any:
    """The field, if it has as many dimensions as the data."""
    target = cfg.model.get("_target_", "") if cfg.get("model") is not None else ""
    found = hydra.utils.get_class(target) if target else None
    if found is None or not issubclass(found, kind):
        name = found.__name__ if found else "nothing"
        advice = "model=hashgrid or model=mlp" if kind is Field else "model=picture_mlp"
        raise InputError("config", "model", name, f"a field of {dimensions} for this dataset", f"choose {advice}")
    return make(cfg, "model", **extra)


def build_system(cfg: DictConfig, scene_frame: "SceneFrame | None") -> System:
    """The LightningModule: NeRF3D for a scene's frame, NeRF2D for a picture (None)."""
    common = {"optimizer": make(cfg, "optimizer"), "schedule": make(cfg, "schedule"), "seed": cfg.seed}
    if scene_frame is None:
        return NeRF2D(build_field(cfg, PictureField, "two coordinates"), **common)
    bounds, background = scene_frame
    field = build_field(cfg, Field, "three coordinates", bounds=bounds)
    sampler = make(cfg, "sampler", bounds=bounds)
    renderer = make(cfg, "renderer", scene_background=background)
    return NeRF3D(field, sampler, renderer, **common)


SceneFrame = tuple[Bounds, tuple[float, float, float]]
"""What a 3D system takes from its scene: where it is, and the colour behind it."""


def frame_of(data: RayDataModule | PixelDataModule) -> SceneFrame | None:
    return None if isinstance(data, PixelDataModule) else (data.scene.bounds, data.scene.background)


def check_background(cfg: DictConfig, data: RayDataModule | PixelDataModule, system: System) -> None:
    """Photos without alpha stand on one colour; asking for another would teach the field a wall of the first."""
    if isinstance(data, PixelDataModule) or data.scene.train.images.shape[-1] == 4:
        return
    assert isinstance(system, NeRF3D)  # what build_system makes for rays
    wanted = "random" if system.renderer.random else [round(c, 3) for c in system.renderer.colour.tolist()]
    if wanted != [round(c, 3) for c in data.scene.background]:
        raise InputError(
            "config: renderer.background",
            "",
            str(cfg.renderer.background),
            f"scene: the photos of {data.scene.name} have no alpha and stand on {list(data.scene.background)}",
        )


def build_budget(cfg: DictConfig) -> Budget:
    """The user's limits, or the experiment's own where the user gives none."""
    given = {key: cfg.budget[key] for key in ("steps", "seconds")}
    return Budget(**(given if any(v is not None for v in given.values()) else dict(cfg.budget.default)))


def build_trainer(cfg: DictConfig, folder: Path) -> L.Trainer:
    """The Trainer with its callbacks, writing into `folder`."""
    logger: Logger | bool = make(cfg, "logger", save_dir=folder) if cfg.get("logger") is not None else False
    chosen = {name: node for name, node in (cfg.get("callbacks") or {}).items() if node is not None}
    callbacks = [make(DictConfig({name: node}, parent=cfg), name) for name, node in chosen.items()]
    results = Results("results.json", cfg.method, cfg.seed)
    # The budget goes first: the others read its clock. Results go before the orbit: figures should not wait for a GIF.
    return make(
        cfg, "trainer", callbacks=[build_budget(cfg), results, *callbacks], logger=logger, default_root_dir=folder
    )
