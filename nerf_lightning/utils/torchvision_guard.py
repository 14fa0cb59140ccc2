"""Keeps a torchvision that cannot be imported from ending every import of Lightning.

Lightning imports torchmetrics, which imports torchvision wherever it is installed; one that was built for another PyTorch
raises RuntimeError.
"""

import importlib
import logging
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution, DistributionFinder, PackageNotFoundError
from typing import Any

NAME = "torchvision"
log = logging.getLogger(__name__)


class TorchvisionGuard(DistributionFinder):
    """Makes a torchvision that cannot be imported look as if it were not installed."""

    def __init__(self) -> None:
        self.problem: str | None = None
        """What is wrong with it and what to do; empty for nothing, None before the first look."""

    def find_distributions(self, context: DistributionFinder.Context | None = None) -> Iterable[Distribution]:
        """What torchmetrics asks first."""
        if context is None or context.name != NAME:
            return ()
        if self.problem is None:
            self.problem = import_problem()
            if self.problem:
                log.warning("%s", self.problem)
        if self.problem:
            raise PackageNotFoundError(NAME)
        return ()

    def find_spec(self, name: str, path: Any, target: Any = None) -> None:
        if name == NAME and self.problem:
            raise ModuleNotFoundError(self.problem, name=NAME)


def import_problem() -> str:
    """Why an installed torchvision cannot be imported and what to do, in a line; empty where it can, or where there is none."""
    try:
        importlib.import_module(NAME)
    except Exception as error:  # noqa: BLE001  (a build for another PyTorch may raise anything)
        if isinstance(error, ModuleNotFoundError) and error.name == NAME:
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
