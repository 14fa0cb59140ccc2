"""nerf_lightning train: Hydra's command line."""

import sys
from typing import Annotated

from cyclopts import Parameter

HYDRA_FLAGS = (
    "-m",
    "--multirun",
    "-c",
    "--cfg",
    "--hydra-help",
    "--resolve",
    "-p",
    "--package",
    "--info",
    "-cd",
    "-cn",
)


def is_override(word: str) -> bool:
    """Whether an argument is for Hydra: KEY=VALUE, +KEY=VALUE, ~KEY or one of its flags."""
    return word.startswith(("+", "~")) or word in HYDRA_FLAGS or "=" in word


def train(*overrides: Annotated[str, Parameter(allow_leading_hyphen=True)]) -> None:
    """Train a field, from options as KEY=VALUE."""
    from nerf_lightning.config import cli

    sys.argv[1:] = overrides
