"""The photos or picture for a run that is read back: those it was trained on, or others. Nothing is downloaded."""

import copy
import inspect
from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig

from nerf_lightning.config.build import build_data, target_of
from nerf_lightning.dataset import BUILT_IN, PixelDataModule, RayDataModule
from nerf_lightning.errors import InputError


def data_again(cfg: DictConfig, scene: Mapping[str, Any], photos: str | None = None) -> RayDataModule | PixelDataModule:
    """The data module of a run. The network is never used, as the run may be a stranger's.

    Args:
        cfg: the run's configuration.
        scene: what its scene.json says.
        photos: a file or folder of others; None takes those it was trained on.

    Raises:
        InputError: if they are gone, or have changed.
    """
    source = scene.get("source", BUILT_IN)
    at_hand = copy.deepcopy(cfg)
    if "download" in inspect.signature(target_of(cfg, "dataset")).parameters:
        at_hand.dataset.download = False
        if at_hand.dataset.get("path") is None and source != BUILT_IN:
            at_hand.dataset.path = source
    data = build_data(at_hand, photos)
    name = scene.get("name", data.scene.name)
    if photos is None and data.scene.name != name:
        expected = f"{name!r}, which the run was trained on"
        raise InputError("config", "dataset", f"the scene {data.scene.name!r}", expected, "give dataset.path=")
    return data
