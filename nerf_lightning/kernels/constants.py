"""Constant tensors that kernels read: made once for each device, as each costs a copy to the device and a wait."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch

Made = TypeVar("Made")

KEPT: list[Callable[..., Any]] = []
"""All functions whose results are cached."""


def constant(make: Callable[..., Made]) -> Callable[..., Made]:
    """Caches a function's results by its arguments. They work with gradients too, even if made in inference mode."""

    @functools.lru_cache(maxsize=64)
    @functools.wraps(make)
    def made(*arguments: object) -> Made:
        with torch.inference_mode(False):
            return make(*arguments)

    KEPT.append(made)
    return made
