"""Cache of constant tensors, created once per device: each creation costs a host-device copy and sync."""

import functools
from collections.abc import Callable
from typing import TypeVar

import torch

T = TypeVar("T")


def cache_constants(make: Callable[..., T]) -> Callable[..., T]:
    """Decorator that caches results by arguments, and creates them outside inference mode so that autograd accepts them."""

    @functools.lru_cache(maxsize=64)
    @functools.wraps(make)
    def cached(*arguments: object) -> T:
        with torch.inference_mode(False):
            return make(*arguments)

    return cached
