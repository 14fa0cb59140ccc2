"""Third-party packages: optional extras, Lightning's log messages, OpenMP's spin-waiting."""

import importlib
import logging
import os
import warnings

from nerf_lightning.errors import InputError

LIGHTNING_LOGGERS = ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero")
OPENMP_SPIN_COUNT = 2000
"""Spin iterations (some microseconds) before GNU OpenMP's threads yield their core. With the default, 300,000 (1 ms), two
trainings in parallel on two cores took 4 to 6 times as long as one alone, with this 1.8 times; one alone is unaffected."""


def require_extra(extra: str, *packages: str, purpose: str, hint: str = "") -> None:
    """Checks that the packages of an optional extra are installed.

    Args:
        extra: its name in pyproject.toml.
        packages: modules of the extra.
        purpose: for the message.
        hint: an alternative, appended to the pip command.

    Raises:
        InputError: for the first package that is missing.
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
    """Silences Lightning's messages about hardware and settings that this package controls."""
    for name in LIGHTNING_LOGGERS:
        logging.getLogger(name).setLevel(logging.WARNING)
    for part in (
        "does not have many workers",
        "GPU available but not used",
        "isinstance.treespec",
        "all_gather is dep",
        "`training_step` returned `None`",
        "running without CUDA graph capture",
    ):
        warnings.filterwarnings("ignore", f".*{part}.*")


def limit_openmp_spinning() -> None:
    """Sets `OPENMP_SPIN_COUNT` before PyTorch is imported, unless the environment sets a wait policy."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(OPENMP_SPIN_COUNT))
