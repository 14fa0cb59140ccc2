"""Configuration: conf/ composed, checked, instantiated. Hydra is known here, in training/ and in cli/train.py."""

from pathlib import Path


def conf_dir() -> Path:
    """The shipped configuration: inside the package in an installed wheel, next to it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    return package / "conf" if (package / "conf").is_dir() else package.parent / "conf"
