"""Counts a device's operations, each a kernel launch, and the host's waits for it (syncs)."""

from collections import Counter
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

SYNC_OPS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::equal", "aten::_unique2")
"""Operations whose result, or its size, the host needs before it can continue."""
INDEX_OPS = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
"""Operations that sync if indexed by a mask."""

FREE_OPS = {f"aten::{name}" for name in ("detach", "_unsafe_view", "empty", "empty_like", "empty_strided", "new_empty")}
"""Operations, other than views, that launch nothing."""


def is_sync(name: str, args: Any, kwargs: Any) -> bool:
    """True if an operation makes the host wait for the device.

    Args:
        name: of the operation, without its overload.
        args, kwargs: of the call.
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
    """Counts dispatched operations within `with OpCounter() as count:`, autograd's included."""

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()
        """Counts of the operations that launch work."""
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
