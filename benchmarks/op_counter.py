"""Counts a device's operations, each a kernel launch, the bytes they move, and the host's waits for it (syncs).

An operation reads each input and writes each output once; caches are left out of account. Where it gathers rows of a table, it
reads at most these rows.
"""

import contextlib
import importlib.util
import math
from collections import Counter
from collections.abc import Sequence
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

from nerf_lightning.kernels import gpu

SYNC_OPS = ("aten::_local_scalar_dense", "aten::nonzero", "aten::masked_select", "aten::equal", "aten::_unique2")
"""Operations whose result, or its size, the host needs before it can continue."""
INDEX_OPS = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")
"""Operations that sync if indexed by a mask."""

FREE_OPS = {f"aten::{name}" for name in ("detach", "_unsafe_view", "empty", "empty_like", "empty_strided", "new_empty")}
"""Operations, other than views, that launch nothing."""
OVERWRITING_OPS = ("copy_", "fill_", "zero_", "uniform_", "normal_", "random_")
"""Operations that write their first argument without reading it."""
PARTIAL_OPS = (
    *("index", "index_select", "gather", "embedding", "take"),
    *("index_add_", "index_put_", "_index_put_impl_", "scatter_add_", "scatter_"),
)
"""Operations that read or change their first argument in part: at most as much as their largest other argument or result."""
TABLE_ROWS = {"tables": 8, "planes": 12, "lines": 6}
"""Rows of a table that GPU kernels read or add to per position and level: the corners of its cells. Keys: the last word of a
parameter's name."""


def is_sync(name: str, args: Any, kwargs: Any) -> bool:
    """True if a call of an operation, named without its overload, makes the host wait for the device."""
    if name in SYNC_OPS:
        return True
    if name in INDEX_OPS:
        return any(isinstance(x, Tensor) and x.dtype in (torch.bool, torch.uint8) for x in args[1])
    if name == "aten::_to_copy":
        to = kwargs.get("device")
        return to is not None and torch.device(to).type == "cpu" != args[0].device.type
    return name == "aten::copy_" and args[0].device.type == "cpu" != args[1].device.type


def count_bytes(tree: Any) -> int:
    """Bytes of all tensors in a tree; repeated elements of expanded tensors count once."""
    tensors = [x for x in pytree.tree_leaves(tree) if isinstance(x, Tensor)]
    shapes = ((n for n, stride in zip(x.shape, x.stride(), strict=True) if stride or not n) for x in tensors)
    return sum(x.itemsize * math.prod(shape) for x, shape in zip(tensors, shapes, strict=True))


def count_op_bytes(function: Any, args: Any, kwargs: Any, out: Any) -> int:
    """Bytes that a dispatched operation reads and writes."""
    schema = function._schema
    name = schema.name.removeprefix("aten::")
    written = count_bytes(out) if any(result.alias_info is None for result in schema.returns) else 0
    if name.endswith("_like") or name.startswith("new_"):
        return written
    names, total = [parameter.name for parameter in schema.arguments], written
    sizes = {key: count_bytes(value) for key, value in {**dict(zip(names, args, strict=False)), **kwargs}.items()}
    for key, size in sizes.items():
        is_first, alias = key == names[0], schema.arguments[names.index(key)].alias_info
        if is_first and name in PARTIAL_OPS:
            size = min(size, max(written, *(other for key, other in sizes.items() if key != names[0])))
        is_overwritten = key == "out" or (is_first and name in OVERWRITING_OPS)
        # Fused optimizers write gradients only where they scale them.
        is_changed = alias is not None and alias.is_write and key != "grads"
        total += size * (2 if is_changed and not is_overwritten else 1)
    return total


def count_kernel_bytes(names: Sequence[str], arguments: Sequence[Any], constants: dict[str, Any]) -> int:
    """Bytes that a GPU kernel reads and writes, given its parameters' names; it adds to the gradients of tables."""
    given, total = dict(zip(names, arguments, strict=False)), 0
    cells = given.get("positions", math.inf) * constants.get("L", 1)
    for name, value in given.items():
        size, rows = count_bytes(value), TABLE_ROWS.get(name.rpartition("_")[2])
        if size and rows:
            size = min(size, rows * cells * value.shape[-1] * value.itemsize)
        total += size * (2 if rows and name.startswith("grad") else 1)
    return total


class OpCounter(TorchDispatchMode):
    """Counts dispatched operations within `with OpCounter() as count:`, autograd's and GPU kernels included."""

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()
        """Counts of the operations that launch work."""
        self.bytes_by_name: Counter[str] = Counter()
        self.waits = 0
        self._patches = contextlib.ExitStack()

    @property
    def operations(self) -> int:
        return self.names.total()

    @property
    def bytes(self) -> int:
        """Bytes read and written."""
        return self.bytes_by_name.total()

    def __enter__(self) -> "OpCounter":
        if importlib.util.find_spec("triton"):
            run = gpu.launch.run_kernel

            def count_and_run(kernel: Any, grid: Any, arguments: Any, constants: Any) -> None:
                self.names[kernel.name] += 1
                self.bytes_by_name[kernel.name] += count_kernel_bytes(kernel.function.arg_names, arguments, constants)
                run(kernel, grid, arguments, constants)

            self._patches.enter_context(mock.patch.object(gpu.launch, "run_kernel", count_and_run))
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._patches.close()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function._schema.name
        kwargs = kwargs or {}
        leaves = pytree.tree_leaves((args, kwargs))
        out = function(*args, **kwargs)
        if not function.is_view and name not in FREE_OPS and ("device" in kwargs or any(map(torch.is_tensor, leaves))):
            self.names[name] += 1
            self.bytes_by_name[name] += count_op_bytes(function, args, kwargs, out)
            self.waits += is_sync(name, args, kwargs)
        return out
