"""Other packages: optional extras, Lightning's remarks, OpenMP's waiting, and a torchvision that does not fit PyTorch."""

import importlib
import logging
import os
import sys
import warnings
from collections.abc import Iterable
from importlib.metadata import Distribution, DistributionFinder, PackageNotFoundError
from typing import Any

from nerf_lightning.errors import InputError

NOISY = ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero")
"""Loggers that report hardware and advice."""
SPIN_COUNT = 2000
"""Rounds that GNU's OpenMP waits (some microseconds) before it gives its core away. With its own 300,000 (a millisecond) two
trainings side by side on two cores took 4 to 6 times as long as one alone, with this 1.8 times; alone nothing changes."""
TORCHVISION = "torchvision"
log = logging.getLogger(__name__)


def require(extra: str, *packages: str, purpose: str, otherwise: str = "") -> None:
    """Raises InputError where a package of an optional extra is not installed.

    Args:
        extra: its name in pyproject.toml.
        packages: what it brings.
        purpose: what it is for, in words.
        otherwise: what else the user can do.
    """
    for package in packages:
        try:
            importlib.import_module(package)
        except ModuleNotFoundError as error:
            if error.name != package:
                raise
            todo = f"pip install 'nerf_lightning[{extra}]'{otherwise}"
            raise InputError(package, "", "no such package", purpose, todo) from error


def silence_lightning() -> None:
    """Silences Lightning's remarks on hardware and settings that this package chooses itself."""
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.WARNING)
    for part in (
        "does not have many workers",
        "GPU available but not used",
        "isinstance.treespec",
        "all_gather is dep",
    ):
        warnings.filterwarnings("ignore", f".*{part}.*")


def shorten_openmp_waits() -> None:
    """Sets `SPIN_COUNT`, before PyTorch is loaded, which reads it; unless the user's environment says how to wait."""
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", str(SPIN_COUNT))


class TorchvisionGuard(DistributionFinder):
    """Makes a torchvision that cannot be imported look as if it were not installed.

    Lightning imports torchmetrics, which imports an installed torchvision; one built for another PyTorch raises RuntimeError.
    """

    def __init__(self) -> None:
        self.problem: str | None = None
        """What is wrong with it and what to do; empty for nothing, None before it was tried."""

    def find_distributions(self, context: DistributionFinder.Context | None = None) -> Iterable[Distribution]:
        """What torchmetrics asks first."""
        if context is None or context.name != TORCHVISION:
            return ()
        if self.problem is None:
            self.problem = torchvision_problem()
            if self.problem:
                log.warning("%s", self.problem)
        if self.problem:
            raise PackageNotFoundError(TORCHVISION)
        return ()

    def find_spec(self, name: str, path: Any, target: Any = None) -> None:
        if name == TORCHVISION and self.problem:
            raise ModuleNotFoundError(self.problem, name=TORCHVISION)


def torchvision_problem() -> str:
    """Why an installed torchvision cannot be imported and what to do, in a line; empty where it can, or where there is none."""
    try:
        importlib.import_module(TORCHVISION)
    except Exception as error:  # noqa: BLE001  (a build for another PyTorch may raise anything)
        if isinstance(error, ModuleNotFoundError) and error.name == TORCHVISION:
            return ""
        import torch

        reason = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        todo = "pip install --force-reinstall --no-deps torchvision, from the package index that PyTorch came from"
        return f"torchvision does not fit PyTorch {torch.__version__} ({reason}), only LPIPS needs it: {todo}"
    return ""


def guard_torchvision() -> None:
    """Installs the guard, which imports nothing until torchmetrics asks for torchvision."""
    if not any(isinstance(finder, TorchvisionGuard) for finder in sys.meta_path):
        sys.meta_path.insert(0, TorchvisionGuard())
