"""What a piece of work asks of a device: operations, each a launch, and waits of the host for it."""

from collections import Counter
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

SYNC_OPS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::equal", "aten::_unique2")
"""Operations whose answer, or whose answer's size, the host has to know before it can go on."""
INDEX_OPS = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
"""Operations that look for the true entries of a mask where they are given one."""

FREE_OPS = {f"aten::{name}" for name in ("detach", "_unsafe_view", "empty", "empty_like", "empty_strided", "new_empty")}
"""Operations, beside views, that launch nothing."""


def is_sync(name: str, args: Any, kwargs: Any) -> bool:
    """Whether the host waits for a device in an operation.

    Args:
        name: of the operation, without that of its overload.
        args, kwargs: what it is given.
    """
    if name in SYNC_OPS:
        return True
    if name in INDEX_OPS:
        return any(isinstance(x, Tensor) and x.dtype in (torch.bool, torch.uint8) for x in args[1])
    if name == "aten::_to_copy":
        to = kwargs.get("device")
        return to is not None and torch.device(to).type == "cpu" != args[0].device.type
    return name == "aten::copy_" and args[0].device.type == "cpu" != args[1].device.type


class OpCounter(TorchDispatchMode):
    """Counts what is asked of the dispatcher inside `with Count() as count:`, autograd's work too."""

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()
        """Operations that work on a device."""
        self.waits = 0

    @property
    def operations(self) -> int:
        return self.names.total()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function._schema.name
        kwargs = kwargs or {}
        leaves = pytree.tree_leaves((args, kwargs))
        if not function.is_view and name not in FREE_OPS and ("device" in kwargs or any(map(torch.is_tensor, leaves))):
            self.names[name] += 1
            self.waits += is_sync(name, args, kwargs)
        return function(*args, **kwargs)
