"""A CUDA graph that exists only in the dispatcher: records operations without effect, and repeats them on the same tensors."""

from typing import Any

import torch
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode


class RecordedGraph(TorchDispatchMode):
    """Stands for `torch.cuda.CUDAGraph`."""

    replays = 0
    """Of all graphs."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, Any, Any, Any]] = []
        self.overwritten: list[tuple[torch.Tensor, torch.Tensor]] = []

    def register_generator_state(self, generator: torch.Generator) -> None:
        """A real graph reads the generator's seed when it is replayed; here the operations do."""

    def pool(self) -> tuple[int, int]:
        return 0, 0

    def capture_begin(self, **options: Any) -> None:
        self.__enter__()

    @torch.no_grad()
    def capture_end(self) -> None:
        self.__exit__(None, None, None)
        for tensor, before in reversed(self.overwritten):
            tensor.copy_(before)
        self.overwritten.clear()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        named = zip(function._schema.arguments, args, strict=False)
        written = [x for argument, x in named if argument.alias_info is not None and argument.alias_info.is_write]
        written += [kwargs[x.name] for x in function._schema.arguments if x.is_out and x.name in kwargs]
        self.overwritten += [(x, x.clone()) for x in pytree.tree_leaves(written) if isinstance(x, torch.Tensor)]
        out = function(*args, **kwargs)
        self.calls.append((function, args, kwargs, out))
        return out

    @torch.no_grad()
    def replay(self) -> None:
        RecordedGraph.replays += 1
        for function, args, kwargs, out in self.calls:
            if function.is_view:
                continue
            again = pytree.tree_leaves(function(*args, **kwargs))
            for old, new in zip(pytree.tree_leaves(out), again, strict=True):
                if isinstance(old, torch.Tensor) and old is not new:
                    old.copy_(new)
