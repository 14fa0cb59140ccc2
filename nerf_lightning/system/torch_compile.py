"""torch.compile for the parts of a training step with a fixed structure: fields and the renderer, not the samplers.

Compiled code belongs to no module: copies, checkpoints and pickles stay as they are, and code compiled for a copy serves the
original.
"""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._pytree import tree_map_only

from nerf_lightning.errors import InputError
from nerf_lightning.kernels.cached_constants import CACHED_FUNCTIONS

COMPILE_BACKEND = "inductor"
"""What a run compiles with."""
MAX_RECOMPILES = 64
"""Most times that a part is compiled again for another size of a growing field; after that it runs uncompiled."""


@functools.cache
def _configure_compiler() -> None:
    """Tells the compiler that what kernels cache for a device is constant."""
    torch._dynamo.config.recompile_limit = MAX_RECOMPILES
    # About just these functions, and about tensors passed from one part to the next.
    for message in (".*`functools.lru_cache`-wrapped function.*", ".*a Tensor that is not a leaf Tensor.*"):
        warnings.filterwarnings("ignore", message)
    for function in CACHED_FUNCTIONS:
        function.__wrapped__ = _assume_constant(function)  # type: ignore[attr-defined]  # what is compiled in its place


def _assume_constant(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function with constant results. They are parameters, as the compiler takes those to have a fixed size."""

    @torch._dynamo.assume_constant_result
    def boxed(*args: Any) -> list[Any]:  # in a list: one graph cannot take two single tensors of the same name
        return [
            tree_map_only(torch.Tensor, lambda x: torch.nn.Parameter(x.clone(), requires_grad=False), function(*args))
        ]

    def made(*args: Any) -> Any:
        return boxed(*args)[0]

    return made


def _canonicalize(value: Any) -> Any:
    """An argument of a compiled part in a standard form: a view of another tensor would be compiled again."""
    if isinstance(value, torch.Tensor):
        return value.contiguous() if value._base is None else value.clone(memory_format=torch.contiguous_format)
    return value


@functools.cache
def _compile_method(function: Callable[..., Any], backend: str) -> Callable[..., Any]:
    """A method of a class, compiled once in a process for all modules of that class."""
    _configure_compiler()
    compiled = torch.compile(function, dynamic=True, backend=backend)

    def call(*args: Any) -> Any:
        return compiled(*(_canonicalize(one) for one in args))

    return call


def maybe_compile(method: Any, backend: str | None) -> Callable[..., Any]:
    """A module's bound method: compiled if there is a backend (positional arguments only), else unchanged."""
    if backend is None:
        return method
    return functools.partial(_compile_method(method.__func__, backend), method.__self__)


def check_compiler(device: torch.device, backend: str) -> None:
    """Compiles a tiny function, to see whether compiling works.

    Raises:
        InputError: if it does not, mostly for want of a C++ compiler, or of Triton for CUDA.
    """

    def double(x: torch.Tensor) -> torch.Tensor:
        return 2 * x

    try:
        with warnings.catch_warnings(), torch._inductor.config.patch(force_disable_caches=True):
            warnings.simplefilter("ignore")  # about missing caches
            torch.compile(double, backend=backend)(torch.ones(3, device=device))
    except RuntimeError as error:
        needed = "a C++ compiler" if device.type == "cpu" else f"what torch.compile needs for {device.type}"
        raise InputError(
            "config",
            "compile",
            f"{needed} is missing ({str(error).strip().splitlines()[0]})",
            hint="install it (g++ or clang++; Triton and gcc for CUDA), or give compile=false",
        ) from error
