"""Run options: top-level keys of a configuration, and groups that null omits."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf, open_dict

from nerf_lightning.config import conf_dir
from nerf_lightning.errors import InputError
from nerf_lightning.utils.option_checks import Count, Le, Seed, check_options

OPTIONAL_GROUPS = ("callbacks", "logger", "recipe", "refine", "renderer", "sampler")
"""Groups that a run may omit: a 2D field has no sampler and no renderer."""
NONE_OPTION = "none"
"""Option of an optional group that sets nothing, as Hydra takes no null for a group."""

for _group in OPTIONAL_GROUPS:
    ConfigStore.instance().store(name=NONE_OPTION, node={}, group=_group, package="_global_", provider="nerf_lightning")


@dataclass(frozen=True)
class RunOptions:
    """Top-level keys of a run's configuration, see conf/config.yaml; groups are checked when they are built."""

    name: str
    method: str
    recipe: str | None
    seed: Seed
    threads: Annotated[Count, Le(1024)] | None
    device: str
    kernels: str
    resume: str | None
    overwrite: bool
    budget: dict
    limits: dict
    dataset: dict
    model: dict
    optimizer: dict
    schedule: dict
    trainer: dict
    sampler: dict | None = None
    renderer: dict | None = None
    refine: dict | None = None
    callbacks: dict | None = None
    logger: dict | None = None
    render: dict | None = None
    """Of 2D experiments: `scale` of the enlarged image."""


def replace_nulls(arguments: Sequence[str]) -> list[str]:
    """Rewrites GROUP=null to GROUP=none on a command line, also among the values of a sweep.

    Raises:
        InputError: for a group that no run can omit.
    """
    replaced, groups = [], {folder.name for folder in conf_dir().iterdir() if folder.is_dir()}
    for argument in arguments:
        key, _, value = argument.partition("=")
        group, values = key.lstrip("+"), value.split(",")
        if "null" in values and group in groups:
            if group not in OPTIONAL_GROUPS:
                options = ", ".join(sorted(file.stem for file in (conf_dir() / group).glob("*.yaml")))
                raise InputError("command line", group, "null", f"one of {options}")
            argument = f"{key}={','.join(NONE_OPTION if name == 'null' else name for name in values)}"
        replaced.append(argument)
    return replaced


def check_run_options(cfg: DictConfig, choices: Mapping[str, str | None]) -> None:
    """Sets omitted groups to null, and checks the top-level keys.

    Args:
        cfg: composed, without Hydra's node.
        choices: option of each group, as Hydra keeps it.

    Raises:
        InputError: for an unknown key, a missing one, and a value of the wrong type.
    """
    with open_dict(cfg):
        for group in OPTIONAL_GROUPS:
            if choices.get(group) == NONE_OPTION and group != "recipe":
                cfg[group] = None
    text, plain = str(OmegaConf.to_container(cfg)), OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(plain, dict)  # of a DictConfig
    used = {str(key) for key in cfg if re.search(rf"\$\{{[^}}]*\b{re.escape(str(key))}\b", text)}
    known = {field.name for field in fields(RunOptions)}
    given = {str(key): value for key, value in plain.items() if key in known or key not in used}
    check_options("", RunOptions, given)
