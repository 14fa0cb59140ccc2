"""Constant tensors that kernels read: made once for each device, as every one costs a copy to it and a wait."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch

Made = TypeVar("Made")

KEPT: list[Callable[..., Any]] = []
"""All functions whose results are kept."""


def constant(make: Callable[..., Made]) -> Callable[..., Made]:
    """Keeps what a function made of arguments that can be compared. It serves with gradients too, whoever asks first."""

    @functools.lru_cache(maxsize=64)
    @functools.wraps(make)
    def made(*arguments: object) -> Made:
        with torch.inference_mode(False):
            return make(*arguments)

    KEPT.append(made)
    return made
