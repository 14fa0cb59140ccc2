"""torch.compile for what has a fixed structure in a training step: fields and the renderer, not the samplers.

What is compiled belongs to no module: copies, checkpoints and pickles stay as they are, and what was compiled for a copy serves
the original.
"""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._pytree import tree_map_only

from nerf_lightning.cameras import InBounds
from nerf_lightning.errors import InputError
from nerf_lightning.kernels.constants import KEPT

BACKEND = "inductor"
"""What a run compiles with."""
VARIANTS = 64
"""How often a part is compiled anew, for sizes that a field grows through; beyond that it runs uncompiled."""


@functools.cache
def _prepare() -> None:
    """What kernels keep for a device are constants rather than something to compile."""
    torch._dynamo.config.recompile_limit = VARIANTS
    # Of just these functions, and of what one part hands to the next.
    for message in (".*`functools.lru_cache`-wrapped function.*", ".*a Tensor that is not a leaf Tensor.*"):
        warnings.filterwarnings("ignore", message)
    for kept in KEPT:
        kept.__wrapped__ = _constant(kept)  # type: ignore[attr-defined]  # what is compiled in its place


def _constant(kept: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, as one whose results are constants: parameters have a fixed size, where other tensors have any."""

    @torch._dynamo.assume_constant_result
    def boxed(*given: Any) -> list[Any]:  # in a list, as one graph takes no two single tensors under the same name
        return [tree_map_only(torch.Tensor, lambda x: torch.nn.Parameter(x.clone(), requires_grad=False), kept(*given))]

    def made(*given: Any) -> Any:
        return boxed(*given)[0]

    return made


def _settled(given: Any) -> Any:
    """What is given to a compiled part, always of one kind: views of other tensors would have it compiled anew."""
    if isinstance(given, torch.Tensor):
        return given.contiguous() if given._base is None else given.clone(memory_format=torch.contiguous_format)
    if isinstance(given, InBounds):
        given.bounds.settle()
    return given


@functools.cache
def _compiled(function: Callable[..., Any], backend: str) -> Callable[..., Any]:
    """A method of a class, compiled once in a process for all modules of that class."""
    _prepare()
    fast = torch.compile(function, dynamic=True, backend=backend)

    def call(*given: Any) -> Any:
        return fast(*(_settled(one) for one in given))

    return call


def part(method: Any, backend: str | None) -> Callable[..., Any]:
    """A module's bound method: compiled where there is a backend, taking arguments in their order alone; else as it is."""
    if backend is None:
        return method
    return functools.partial(_compiled(method.__func__, backend), method.__self__)


def check_compiler(device: torch.device, backend: str) -> None:
    """Compiles next to nothing, to see whether that can be done.

    Raises:
        InputError: where it cannot: mostly there is no C++ compiler, or for CUDA no Triton.
    """

    def double(x: torch.Tensor) -> torch.Tensor:
        return 2 * x

    try:
        with warnings.catch_warnings(), torch._inductor.config.patch(force_disable_caches=True):
            warnings.simplefilter("ignore")  # of what is missing without caches
            torch.compile(double, backend=backend)(torch.ones(3, device=device))
    except RuntimeError as error:
        needed = "a C++ compiler" if device.type == "cpu" else f"what torch.compile needs for {device.type}"
        raise InputError(
            "config",
            "compile",
            f"true, but {str(error).strip().splitlines()[0]}",
            needed,
            "install it (g++ or clang++; Triton and gcc for CUDA), or give compile=false",
        ) from error
