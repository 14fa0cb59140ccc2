"""Dataclasses of tensors that move between devices as one."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T", bound="TensorDataclass")


@dataclass(frozen=True)
class TensorDataclass:
    """Base of frozen dataclasses whose fields are tensors, other TensorDataclasses, or plain values."""

    def map_tensors(self: T, operation: Callable[[Tensor], Tensor]) -> T:
        """A copy with an operation applied to each tensor."""
        changed: dict[str, object] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.init and isinstance(value, Tensor):
                changed[field.name] = operation(value)
            elif isinstance(value, TensorDataclass):
                changed[field.name] = value.map_tensors(operation)
        return replace(self, **changed)

    def to(self: T, device: torch.device | str) -> T:
        return self.map_tensors(lambda x: x.to(device))

    def detach(self: T) -> T:
        return self.map_tensors(Tensor.detach)

    def __getitem__(self: T, index: slice | Tensor) -> T:
        """Indexes the first dimension of each tensor."""
        return self.map_tensors(lambda x: x[index])
