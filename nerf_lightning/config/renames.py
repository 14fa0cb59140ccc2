"""Options that used to have another name: command lines, experiments and runs with the old one still work."""

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict

RENAMED = {
    "renderer.distortion": "renderer.distortion_loss_weight",
    "sampler.transparent": "sampler.early_stop_eps",
    "sampler.thin": "sampler.alpha_thre",
}
GRIDS = ("HashGridField", "TensoRFField", "VoxelField")
"""Models whose runs without `size` were made with a fixed size; runs on photos without `undistort` resampled these, those
without `focus` drew all rays alike, and those of pictures without `share` held half as many numbers."""

LEFT_OUT = {
    **dict.fromkeys(GRIDS, ("model", "size", "auto")),
    "HashGrid2DField": ("model", "share", 1.0),
    "from_photos": ("dataset", "undistort", False),
}
"""By what a group names: options without which a run is taken for one of those, and what they are today if left out."""


def with_what_was_left_out(config: Mapping[str, Any]) -> dict[str, Any]:
    """A new run's configuration (plain values), which says also what `~model.size` leaves to the model."""
    found = dict(config)
    for name, (group, option, default) in LEFT_OUT.items():
        options = found.get(group)
        if isinstance(options, dict) and str(options.get("_target_")).rpartition(".")[2] == name:
            found[group] = {option: default, **options}
    return found


def with_new_names(config: Mapping[str, Any]) -> dict[str, Any]:
    """A run's configuration (plain values) with each option under its present name; no warning, as runs cannot be edited."""
    renamed = dict(config)
    for old, new in RENAMED.items():
        (group, before), after = old.split("."), new.rpartition(".")[2]
        options = renamed.get(group)
        if isinstance(options, dict) and before in options:
            renamed[group] = {after if key == before else key: value for key, value in options.items()}
    model = renamed.get("model")
    if isinstance(model, dict) and str(model.get("_target_")).rpartition(".")[2] in GRIDS:
        renamed["model"] = {"size": "fixed", **model}
    if isinstance(model, dict) and str(model.get("_target_")).endswith(".HashGrid2DField"):
        renamed["model"] = {"share": 0.5, **model}
    dataset = renamed.get("dataset")
    if isinstance(dataset, dict):
        source = str(dataset.get("_target_")).rpartition(".")[2]
        if source in ("from_photos", "from_bricks", "from_download"):
            resampled = {"undistort": True} if source == "from_photos" else {}
            renamed["dataset"] = {**resampled, "focus": 0.0, **dataset}
    return renamed


def rename_given(cfg: DictConfig) -> None:
    """Moves what a user's experiment sets under an old name to the new one, in place, with a warning."""
    for old, new in RENAMED.items():
        group, name = old.split(".")
        options = cfg.get(group)
        if isinstance(options, DictConfig) and name in options:
            _warn(old, new)
            with open_dict(cfg):
                OmegaConf.update(cfg, new, options.pop(name))


def renamed_overrides(arguments: Sequence[str]) -> list[str]:
    """A command line with each option under its present name, with a warning for each old one."""
    found = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        new = RENAMED.get(key.lstrip("+"))
        if new is not None:
            _warn(key.lstrip("+"), new)
            argument = f"{new}{equals}{value}"
        found.append(argument)
    return found


def _warn(old: str, new: str) -> None:
    print(f"nerf_lightning: {old} is now called {new}; the old name still works", file=sys.stderr)
