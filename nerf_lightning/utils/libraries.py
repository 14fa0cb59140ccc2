"""Other packages: optional extras, Lightning's remarks and OpenMP's waiting."""

import importlib
import logging
import os
import warnings

from nerf_lightning.errors import InputError

LIGHTNING_LOGGERS = ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero")
"""Loggers that report hardware and advice."""
OPENMP_SPIN_COUNT = 2000
"""Rounds that GNU's OpenMP waits (some microseconds) before it gives its core away. With its own 300,000 (a millisecond) two
trainings side by side on two cores took 4 to 6 times as long as one alone, with this 1.8 times; alone nothing changes."""


def require_extra(extra: str, *packages: str, purpose: str, hint: str = "") -> None:
    """Raises InputError where a package of an optional extra is not installed.

    Args:
        extra: its name in pyproject.toml.
        packages: what it brings.
        purpose: what it is for, in words.
        hint: what else the user can do.
    """
    for package in packages:
        try:
            importlib.import_module(package)
        except ModuleNotFoundError as error:
            if error.name != package:
                raise
            hint = f"pip install 'nerf_lightning[{extra}]'{hint}"
            raise InputError(package, "", f"not installed: {purpose}", hint=hint) from error


def silence_lightning() -> None:
    """Silences Lightning's remarks on hardware and settings that this package chooses itself."""
    for name in LIGHTNING_LOGGERS:
        logging.getLogger(name).setLevel(logging.WARNING)
    for part in (
        "does not have many workers",
        "GPU available but not used",
        "isinstance.treespec",
        "all_gather is dep",
    ):
        warnings.filterwarnings("ignore", f".*{part}.*")


def limit_openmp_spinning() -> None:
    """Sets `OPENMP_SPIN_COUNT`, before PyTorch is loaded, which reads it; unless the user's environment says how to wait."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(OPENMP_SPIN_COUNT))
