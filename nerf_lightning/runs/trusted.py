"""What a configuration from outside may name: a stranger's run folder or compact file must not execute code."""

import importlib
import math
import os
from pathlib import Path
from typing import Any

from nerf_lightning.config.literal import escape
from nerf_lightning.errors import InputError

TRUST = "NERF_LIGHTNING_TRUST"
"""Environment variable: further packages, comma-separated, whose classes a run folder may name."""

TARGETS = {
    "lightning": ("Trainer",),
    "lightning.pytorch.loggers": ("CSVLogger", "TensorBoardLogger"),
    "nerf_lightning.callbacks": (
        *("Baselines", "Checkpoints", "Enlarge", "Guard", "HeldOut", "Live", "Orbit", "PictureCharts", "Progress"),
        *("Snapshots", "Throughput", "TrainingGif"),
    ),
    "nerf_lightning.dataset": ("from_bricks", "from_download", "from_photos", "from_picture"),
    "nerf_lightning.model": (
        *("FourierField", "HashGrid2DField", "HashGridField", "MLPField", "PictureMLP", "SirenField", "TensoRFField"),
        "VoxelField",
    ),
    "nerf_lightning.refine": ("Corrections",),
    "nerf_lightning.renderer": ("VolumeRenderer",),
    "nerf_lightning.sampler": (
        *("ImportanceSampler", "OccupancySampler", "ProposalSampler", "UniformSampler"),
        "suited_sampler",
    ),
    "nerf_lightning.system": ("constant", "cosine", "exponential"),
    "nerf_lightning.training.loggers": ("TensorBoard", "mlflow", "wandb"),
    "torch.optim": ("Adam", "AdamW"),
}
"""What a run folder may name, by module. Anything else could be called with a stranger's arguments."""
MOST_VALUES = 4096
"""In a configuration: those of runs have some 150, and OmegaConf takes a tenth of a millisecond for each, several times."""


def check_config(plain: Any, path: Path | str) -> dict[str, Any]:
    """Checks a configuration from outside: plain values, and only trusted targets.

    Args:
        plain: as it was read.
        path: where it came from, for messages.

    Returns:
        The configuration, escaped for OmegaConf: text from outside is never an interpolation.

    Raises:
        InputError: if it holds anything else.
    """
    if not isinstance(plain, dict):
        raise InputError(path, "", type(plain).__name__, "a mapping")
    if (values := _values(plain)) > MOST_VALUES:
        raise InputError(path, "", f"{values:,} values", f"a configuration of at most {MOST_VALUES:,}")
    _check(path, "", plain)
    return escape(plain)


def _values(node: Any) -> int:
    parts = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return 1 + sum(map(_values, parts))


def _check(path: Path | str, key: str, node: Any) -> None:
    if isinstance(node, dict):
        for name, value in node.items():
            if not isinstance(name, str):
                raise InputError(path, key, f"the key {name!r}", "names of options")
            _check(path, f"{key}.{name}" if key else name, value)
            if name == "_target_" and not _trusted(value):
                raise InputError(
                    path,
                    f"{key}._target_",
                    repr(value),
                    "a class of this package that configurations name",
                    f"set {TRUST} to allow its package",
                )
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _check(path, f"{key}[{index}]", value)
    elif node == "???":
        raise InputError(path, key, repr(node), "a resolved value")
    elif isinstance(node, float) and not math.isfinite(node):
        raise InputError(path, key, str(node), "a finite number")
    elif not isinstance(node, str | int | float | None):
        raise InputError(path, key, f"a {type(node).__name__}", "plain values")


def _trusted(target: Any) -> bool:
    """Whether a target is on the list, or defined (not merely imported) in a package that the user trusts."""
    if not isinstance(target, str):
        return False
    module, _, name = target.rpartition(".")
    if name in TARGETS.get(module, ()):
        return True
    package = target.split(".")[0]
    if package not in filter(None, os.environ.get(TRUST, "").split(",")):
        return False
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return False
    return getattr(found, "__module__", "").split(".")[0] == package
