"""What a configuration from outside may name: a stranger's run folder or compact file must not execute code."""

import functools
import importlib
import math
import os
import re
from pathlib import Path
from typing import Any

from nerf_lightning.config import conf_dir
from nerf_lightning.config.literal import escape
from nerf_lightning.errors import InputError

TRUST = "NERF_LIGHTNING_TRUST"
"""Environment variable: further packages, comma-separated, whose classes a run folder may name."""
SWEEP_CALLBACK = "nerf_lightning.training.sweep.SweepReport"
"""Hydra's, never in a run's configuration."""


@functools.cache
def shipped_targets() -> frozenset[str]:
    """What the shipped configuration builds. Anything else could be called with a stranger's arguments."""
    texts = "".join(file.read_text(encoding="utf-8") for file in conf_dir().rglob("*.yaml"))
    return frozenset(re.findall(r"_target_: ([\w.]+)", texts)) - {SWEEP_CALLBACK}


def check_config(plain: Any, path: Path | str) -> dict[str, Any]:
    """Checks a configuration from outside: plain finite values, and only trusted targets.

    Returns:
        The configuration, escaped for OmegaConf: text from outside is never an interpolation.

    Raises:
        InputError: if it holds anything else; `path` is where it came from.
    """
    if not isinstance(plain, dict):
        raise InputError(path, "", type(plain).__name__, "a mapping")
    _check(path, "", plain)
    return escape(plain)


def _check(path: Path | str, key: str, node: Any) -> None:
    if isinstance(node, dict):
        for name, value in node.items():
            if name == "_target_" and not _is_trusted(value):
                expected = "a class of this package that configurations name"
                raise InputError(path, f"{key}._target_", repr(value), expected, f"set {TRUST} to allow its package")
            _check(path, f"{key}.{name}" if key else str(name), value)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _check(path, f"{key}[{index}]", value)
    elif node == "???" or not isinstance(node, str | int | float | None):
        raise InputError(path, key, repr(node), "plain values")
    elif isinstance(node, float) and not math.isfinite(node):
        raise InputError(path, key, str(node), "a finite number")


def _is_trusted(target: Any) -> bool:
    """Whether a target is on the list, or defined (not merely imported) in a package that the user trusts."""
    if str(target) in shipped_targets():
        return True
    module, _, name = str(target).rpartition(".")
    package = module.split(".")[0]
    if not package or package not in os.environ.get(TRUST, "").split(","):
        return False
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return False
    return getattr(found, "__module__", "").split(".")[0] == package
