"""What a command line may set: the keys that stand in conf/, and groups, of which some can be left out with null."""

import difflib
import math
import re
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf, open_dict

from nerf_lightning.config import conf_dir
from nerf_lightning.errors import InputError

OPTIONAL = ("callbacks", "logger", "recipe", "refine", "renderer", "sampler")
"""Groups that a command can do without; a picture, without the sampler and the renderer that a scene needs."""
NONE = "none"
"""Their option that stands for nothing: Hydra takes no null for a group."""


def register() -> None:
    """Gives the optional groups an option that sets nothing."""
    for group in OPTIONAL:
        ConfigStore.instance().store(name=NONE, node={}, group=group, package="_global_", provider="nerf_lightning")


register()


def without_nulls(arguments: Sequence[str]) -> list[str]:
    """A command line with `GROUP=none` for `GROUP=null`, also among the values of a sweep.

    Raises:
        InputError: for a group that no command can do without.
    """
    found, groups = [], {folder.name for folder in conf_dir().iterdir() if folder.is_dir()}
    for argument in arguments:
        key, _, value = argument.partition("=")
        group, values = key.lstrip("+"), value.split(",")
        if "null" in values and group in groups:
            if group not in OPTIONAL:
                options = ", ".join(sorted(file.stem for file in (conf_dir() / group).glob("*.yaml")))
                raise InputError("command line", group, "null", f"one of {options}")
            argument = f"{key}={','.join(NONE if one == 'null' else one for one in values)}"
        found.append(argument)
    return found


def check_keys(cfg: DictConfig, config: str, choices: Mapping[str, str | None]) -> None:
    """Leaves out what was set to null, and refuses keys that nothing reads. Options of a group are checked when it is built.

    Args:
        cfg: composed.
        config: name of the verb's file in conf/.
        choices: what was chosen of each group, as Hydra keeps it.

    Raises:
        InputError: for a key that does not stand in conf/, a value where keys belong, nan and infinity, and a whole number
            that no float can hold.
    """
    with open_dict(cfg):
        for group in OPTIONAL:
            if choices.get(group) == NONE:
                cfg[group] = None
    known = _known(config)
    if "dataset" in choices and not set(cfg) <= set(known):  # what shipped experiments add
        for file in (conf_dir() / "experiment").glob("*.yaml"):
            known = {**_content(file.stem, "experiment", ("hydra", "defaults")), **known}
    packages = {re.split("[/.]", name.rpartition("@")[2])[0] for name in choices}
    groups = dict.fromkeys(packages - {"hydra", "experiment"})
    found = OmegaConf.to_container(cfg)
    _check_numbers(found, "")
    _check(found, {**known, **groups}, "", str(found))


def _check_numbers(found: Any, where: str) -> None:
    inside = found.items() if isinstance(found, dict) else enumerate(found) if isinstance(found, list) else ()
    for key, value in inside:
        _check_numbers(value, f"{where}.{key}" if where else str(key))
    if isinstance(found, int) and abs(found) > sys.float_info.max:
        digits, most = len(str(abs(found))), sys.float_info.max_10_exp
        raise InputError("config", where, f"a whole number of {digits} digits", f"at most {most}")
    if isinstance(found, float) and not math.isfinite(found):
        raise InputError("config", where, str(found), "a finite number")


def _check(found: Any, known: Mapping[str, Any], where: str, text: str) -> None:
    for key, value in found.items():
        if key not in known and not re.search(rf"\$\{{[^}}]*\b{re.escape(str(key))}\b", text):  # by another value
            near = difflib.get_close_matches(str(key), known, 1)
            names = f"one of {', '.join(sorted(known))}"
            raise InputError(
                "config", f"{where}{key}", "an unknown option", names, f"did you mean {near[0]}?" if near else ""
            )
        if isinstance(of_key := known.get(key), dict):
            if not isinstance(value, dict):
                raise InputError("config", f"{where}{key}", repr(value)[:60], f"{', '.join(of_key)}, each by its name")
            _check(value, of_key, f"{where}{key}.", text)


def _known(config: str) -> dict[str, Any]:
    """The keys of a file in conf/ and of those that it includes; None for a group."""
    content = _content(config)
    for entry in content.pop("defaults", []):
        if isinstance(entry, str) and entry != "_self_":
            content = {**_known(entry), **content}
        elif isinstance(entry, dict):
            content |= {group: None for group in entry if not group.startswith("override ")}
    return content


def _content(name: str, folder: str = "", without: Sequence[str] = ("hydra",)) -> dict[str, Any]:
    content = yaml.safe_load((conf_dir() / folder / f"{name}.yaml").read_text(encoding="utf-8"))
    return {key: value for key, value in content.items() if key not in without}


def check_swept(arguments: Sequence[str]) -> None:
    """Refuses keys that stand twice where one is swept: jobs are named after the keys that differ.

    Args:
        arguments: of a sweep, without flags.

    Raises:
        InputError: for such a key.
    """
    seen: dict[str, bool] = {}
    for override in OverridesParser.create().parse_overrides(list(arguments)):
        key, swept = override.key_or_group, override.is_sweep_override()
        if (swept and key in seen) or seen.get(key):
            raise InputError("command line", key, "a value twice, and several to sweep", f"{key} once", "leave one out")
        seen[key] = swept
