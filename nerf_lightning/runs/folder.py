"""The run folder: its files, and safe loading.

config.yaml            the resolved configuration
scene.json             bounds, background and orbit of the scene, so that rendering needs no photos; corrected cameras
checkpoints/           last.ckpt, best.ckpt: tensors and plain values only
results.json           see callbacks/results.py
snapshots/ orbit.gif   pictures
"""

import functools
import importlib
import math
import os
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
import yaml
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

import nerf_lightning
from nerf_lightning.cameras import Cameras
from nerf_lightning.config import conf_dir
from nerf_lightning.config.build import build_system, resolve_config
from nerf_lightning.config.options import RunOptions
from nerf_lightning.config.quoting import escape_interpolations
from nerf_lightning.errors import InputError, attribute_errors_to
from nerf_lightning.runs.checkpoint import check_finite, read_checkpoint
from nerf_lightning.runs.scene_file import parse_metadata, read_scene_file
from nerf_lightning.system import System
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.files import expand_user_path, write_text
from nerf_lightning.utils.option_checks import check_options
from nerf_lightning.utils.parsing import VALUE_ERRORS, read_yaml, require_file

COMMAND_KEYS = ("overwrite", "version")
"""Config keys of a command rather than of the run."""
VERSION = ".".join(nerf_lightning.__version__.split(".")[:2])
"""Package version stored with runs; runs of other versions are rejected."""
TRUSTED_PACKAGES_VARIABLE = "NERF_LIGHTNING_TRUSTED_PACKAGES"
"""Environment variable: comma-separated packages whose classes a run's configuration may name."""
SWEEP_CALLBACK = "nerf_lightning.training.sweep.SweepReport"
"""Hydra callback, never part of a run's configuration."""


@functools.cache
def list_shipped_targets() -> frozenset[str]:
    """Targets of the shipped configuration: the only ones a run may instantiate by default."""
    texts = "".join(file.read_text(encoding="utf-8") for file in conf_dir().rglob("*.yaml"))
    return frozenset(re.findall(r"_target_: ([\w.]+)", texts)) - {SWEEP_CALLBACK}


def config_to_dict(cfg: DictConfig) -> dict[str, Any]:
    """The resolved configuration as plain values, with an absolute dataset path."""
    plain = {"version": VERSION} | {key: value for key, value in resolve_config(cfg).items() if key not in COMMAND_KEYS}
    path = plain["dataset"].get("path")
    if path is not None:
        plain["dataset"]["path"] = os.path.abspath(expand_user_path(path))
    return plain


def save_config(cfg: DictConfig, folder: Path) -> None:
    write_text(folder / "config.yaml", yaml.safe_dump(config_to_dict(cfg), sort_keys=False))


def load_config(folder: Path) -> DictConfig:
    """Loads a run's configuration; never instantiates untrusted classes.

    Raises:
        InputError: the file is missing or damaged, holds interpolations, or names an untrusted target.
    """
    path = folder / "config.yaml"
    require_file(path, "the folder of a run", "look below outputs/")
    return parse_config(read_yaml(path, "a run's configuration in YAML"), path)


def parse_config(plain: Any, path: Path | str) -> DictConfig:
    """As `load_config`, for the parsed content of the file `path`."""
    if not isinstance(plain, dict):
        raise InputError(path, "", type(plain).__name__, "a mapping")
    check_config(path, "", plain)
    if (version := plain.get("version")) != VERSION:
        problem = "no version" if version is None else f"version {version}"
        hint = "train the run again, or use the version of nerf_lightning that made it"
        raise InputError(path, "version", problem, f"version {VERSION}, which this one reads", hint)
    known = {field.name for field in fields(RunOptions)}
    options = {key: value for key, value in plain.items() if key in known}
    check_options("", RunOptions, options, COMMAND_KEYS, source=str(path))
    try:
        return OmegaConf.create(escape_interpolations(plain))  # untrusted text is never an interpolation
    except RecursionError as error:
        raise InputError(path, "", "values are nested too deep") from error


def check_config(path: Path | str, key: str, node: Any) -> None:
    """Checks that an untrusted configuration holds only plain finite values and trusted targets."""
    if isinstance(node, dict):
        for name, value in node.items():
            if name == "_target_" and not _is_trusted(value):
                expected = "a class of this package that configurations name"
                hint = f"set {TRUSTED_PACKAGES_VARIABLE} to allow its package"
                raise InputError(path, f"{key}._target_", repr(value), expected, hint)
            check_config(path, f"{key}.{name}" if key else str(name), value)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            check_config(path, f"{key}[{index}]", value)
    elif node == "???" or not isinstance(node, str | int | float | None):
        raise InputError(path, key, repr(node), "plain values")
    elif isinstance(node, float) and not math.isfinite(node):
        raise InputError(path, key, str(node), "a finite number")


def _is_trusted(target: Any) -> bool:
    """Whether a target is shipped, or defined (not merely imported) in a package the user trusts."""
    if str(target) in list_shipped_targets():
        return True
    module, _, name = str(target).rpartition(".")
    package = module.split(".")[0]
    if not package or package not in os.environ.get(TRUSTED_PACKAGES_VARIABLE, "").split(","):
        return False
    try:
        value = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return False
    return getattr(value, "__module__", "").split(".")[0] == package


@dataclass(frozen=True)
class LoadedRun:
    """A loaded run, ready to render."""

    cfg: DictConfig
    system: System
    orbit: Cameras | None
    """None for an image."""
    to_source: Float[Tensor, "4 4"] | None
    """Similarity transform from the world frame to the dataset's frame; None for an image."""
    scene: dict[str, Any]
    """Content of scene.json."""


def load_run(folder: Path, checkpoint: str = "last.ckpt", device: torch.device = CPU) -> LoadedRun:
    """Loads a trained system from its run folder.

    Raises:
        InputError: a file is missing, damaged, or inconsistent with the others.
    """
    cfg, scene = load_config(folder), read_scene_file(folder)
    frame, orbit, to_source = parse_metadata(scene, folder / "scene.json")
    with attribute_errors_to(folder / "config.yaml"):
        system = build_system(cfg, frame, device)
    path = folder / "checkpoints" / checkpoint
    state = read_checkpoint(path)
    try:
        # Corrections belong to training photos, which rendering does not need.
        weights = {key: value for key, value in state["state_dict"].items() if not key.startswith("corrections.")}
        system.load_state_dict(weights)
    except VALUE_ERRORS as error:
        raise InputError(path, "state_dict", f"not the weights of this run's model: {error}") from error
    check_finite(system, path)
    return LoadedRun(cfg, system.eval().to(device), orbit, to_source, scene)
