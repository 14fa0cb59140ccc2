"""Constant tensors that kernels read: made once for each device, as each costs a copy to the device and a wait."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch

T = TypeVar("T")

CACHED_FUNCTIONS: list[Callable[..., Any]] = []
"""All functions whose results are cached."""


def cache_constants(make: Callable[..., T]) -> Callable[..., T]:
    """Caches a function's results by its arguments. They work with gradients too, even if made in inference mode."""

    @functools.lru_cache(maxsize=64)
    @functools.wraps(make)
    def made(*arguments: object) -> T:
        with torch.inference_mode(False):
            return make(*arguments)

    CACHED_FUNCTIONS.append(made)
    return made
