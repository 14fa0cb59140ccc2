"""Optional extras: packages that only some verbs need."""

import importlib

from nerf_lightning.errors import InputError


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
