"""What a piece of work asks of a device: operations, each a launch or at least a call, and waits of the host for it."""

from collections import Counter
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

WAITS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::equal", "aten::_unique2")
"""Operations whose answer, or whose answer's size, the host has to know before it can go on."""
INDEXED = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
"""Operations that look for the true entries of a mask where they are given one."""


def waits(name: str, arguments: Any) -> bool:
    """Whether the host waits for a device in an operation.

    Args:
        name: of the operation, without that of its overload.
        arguments: positional ones.
    """
    if name in WAITS:
        return True
    if name in INDEXED:
        return any(isinstance(x, Tensor) and x.dtype in (torch.bool, torch.uint8) for x in arguments[1])
    return False


class Count(TorchDispatchMode):
    """Counts what is asked of the dispatcher inside `with Count() as count:`, views among it; autograd's work too."""

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()
        self.waits = 0

    @property
    def operations(self) -> int:
        return self.names.total()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function._schema.name
        self.names[name] += 1
        self.waits += waits(name, args)
        return function(*args, **(kwargs or {}))
