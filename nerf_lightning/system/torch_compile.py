"""torch.compile for the parts of a training step with a fixed structure: fields and renderer, not samplers.

Compiled code belongs to a class, not to a module: copies, checkpoints and pickles stay unchanged, and copies share it.
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
MAX_RECOMPILES = 64
"""Recompilations of a part for new sizes of a growing field; beyond that it runs uncompiled."""


@functools.cache
def _configure_compiler() -> None:
    """Configures Dynamo: the recompile limit, and cached kernel constants as constant."""
    torch._dynamo.config.recompile_limit = MAX_RECOMPILES
    # Warnings about these functions and about tensors passed between parts.
    for message in (".*`functools.lru_cache`-wrapped function.*", ".*a Tensor that is not a leaf Tensor.*"):
        warnings.filterwarnings("ignore", message)
    for function in CACHED_FUNCTIONS:
        function.__wrapped__ = _assume_constant(function)  # type: ignore[attr-defined]  # what is compiled in its place


def _assume_constant(function: Callable[..., Any]) -> Callable[..., Any]:
    """Makes a function's results constants of the graph: parameters, whose size the compiler takes as fixed."""

    @torch._dynamo.assume_constant_result
    def call_boxed(*args: Any) -> list[Any]:  # in a list: one graph cannot take two single tensors of the same name
        outputs = function(*args)
        return [tree_map_only(torch.Tensor, lambda x: torch.nn.Parameter(x.clone(), requires_grad=False), outputs)]

    def call_unboxed(*args: Any) -> Any:
        return call_boxed(*args)[0]

    return call_unboxed


def _canonicalize(value: Any) -> Any:
    """Canonicalizes an argument (contiguous, not a view), to avoid recompilation."""
    if isinstance(value, torch.Tensor):
        return value.contiguous() if value._base is None else value.clone(memory_format=torch.contiguous_format)
    return value


@functools.cache
def _compile_method(function: Callable[..., Any], backend: str) -> Callable[..., Any]:
    """Compiles a method once per process, for all modules of its class."""
    _configure_compiler()
    compiled = torch.compile(function, dynamic=True, backend=backend)

    def call(*args: Any) -> Any:
        return compiled(*(_canonicalize(arg) for arg in args))

    return call


def maybe_compile(method: Any, backend: str | None) -> Callable[..., Any]:
    """Compiles a module's bound method (positional arguments only); unchanged without a backend."""
    if backend is None:
        return method
    return functools.partial(_compile_method(method.__func__, backend), method.__self__)


def check_compiler(device: torch.device, backend: str) -> None:
    """Checks that torch.compile works, by compiling a tiny function.

    Raises:
        InputError: if it fails, mostly without a C++ compiler, or without Triton for CUDA.
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
