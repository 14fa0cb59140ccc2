"""Compilation and launch of Triton kernels through the CUDA driver.

Triton's own launcher compiles a C file at the first launch and so needs gcc and Python.h. Compiling for a stated target needs
neither, and the driver loads the result.
"""

import ctypes
import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
import triton
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime.interpreter import InterpretedFunction

TYPE_NAMES = {
    torch.float32: "*fp32",
    torch.float16: "*fp16",
    torch.int64: "*i64",
    torch.int32: "*i32",
    torch.bool: "*u8",
    torch.uint8: "*u8",
}
"""Triton's names of pointers to tensors."""
C_TYPES: dict[type, Any] = {int: ctypes.c_int32, float: ctypes.c_float}
ALIGNMENT_BYTES = 16
"""Alignment of a pointer that lets Triton read vectors."""
DEFAULT_SHARED_BYTES = 48 << 10
"""Shared memory per block that needs no request."""
MAX_DYNAMIC_SHARED_ATTRIBUTE = 8  # CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
WARP_SIZE = 32

Grid = tuple[int, ...]
"""Number of programs along up to three axes."""


class Kernel:
    """A Triton kernel. Calls pass its tensors, integers and floats in order, and its constants by name.

    Args:
        function: parameters annotated with `tl.constexpr` are constants, the last ones.
        num_warps: warps per program.
    """

    def __init__(self, function: Callable[..., None], num_warps: int = 4):
        self.function = triton.jit(function)
        self.name = f"{function.__module__.rpartition('.')[2]}.{function.__name__}"
        self.num_warps = num_warps
        self.loaded: dict[Any, tuple[ctypes.c_void_p, int]] = {}
        """Function and shared memory in bytes of each compiled variant."""

    def __call__(self, grid: Grid, *arguments: Tensor | int | float, **constants: Any) -> None:
        if all(grid):
            run_kernel(self, grid, arguments, constants)

    def compile(self, capability: int, arguments: Sequence[Tensor | int | float], constants: dict[str, Any]) -> Any:
        """Compiles for a compute capability (times ten) and these types of arguments; needs no GPU."""
        names, types = self.function.arg_names, describe_arguments(arguments)
        signature = dict(zip(names, (name for name, _ in types), strict=False)) | dict.fromkeys(constants, "constexpr")
        aligned = {
            (i,): [["tt.divisibility", ALIGNMENT_BYTES]] for i, (_, is_aligned) in enumerate(types) if is_aligned
        }
        values = {(names.index(name),): value for name, value in constants.items()}
        target = GPUTarget("cuda", capability, WARP_SIZE)
        source = ASTSource(self.function, signature, values, aligned)
        # Without fused multiply-add, rounding decides between cells as in the reference.
        options = {"num_warps": self.num_warps, "enable_fp_fusion": False}
        return triton.compile(source, target=target, options=options)


def kernel(num_warps: int = 4) -> Callable[[Callable[..., None]], Kernel]:
    """Decorator that makes a Triton kernel of a function."""
    return functools.partial(Kernel, num_warps=num_warps)


def describe_arguments(arguments: Sequence[Tensor | int | float]) -> list[tuple[str, bool]]:
    """Triton's type of each argument, and whether it is an aligned pointer."""
    return [
        (TYPE_NAMES[x.dtype], x.data_ptr() % ALIGNMENT_BYTES == 0)
        if isinstance(x, Tensor)
        else ("fp32" if isinstance(x, float) else "i32", False)
        for x in arguments
    ]


def run_kernel(
    kernel: Kernel, grid: Grid, arguments: Sequence[Tensor | int | float], constants: dict[str, Any]
) -> None:
    """Launches a kernel on the current stream of its first tensor's device; on a CPU, runs it in Triton's interpreter."""
    if isinstance(kernel.function, InterpretedFunction):
        kernel.function[grid](*arguments, **constants)
        return
    device = next(x.device for x in arguments if isinstance(x, Tensor))
    with torch.cuda.device(device):
        key = (device.index, *describe_arguments(arguments), *constants.items())
        if key not in kernel.loaded:
            major, minor = torch.cuda.get_device_capability(device)
            kernel.loaded[key] = load_binary(kernel.compile(10 * major + minor, arguments, constants))
        stream = torch.cuda.current_stream(device).cuda_stream
        launch_binary(*kernel.loaded[key], grid, WARP_SIZE * kernel.num_warps, stream, arguments)


@functools.cache
def load_driver() -> ctypes.CDLL:
    """Loads the CUDA driver's library."""
    return ctypes.CDLL("libcuda.so.1")


def check(code: int) -> None:
    """Raises RuntimeError for an error code of the driver."""
    if code:
        raise RuntimeError(f"CUDA driver error {code}")


def load_binary(compiled: Any) -> tuple[ctypes.c_void_p, int]:
    """Loads a compiled kernel into the current CUDA context. Returns its function and its shared memory in bytes."""
    driver, module, function = load_driver(), ctypes.c_void_p(), ctypes.c_void_p()
    check(driver.cuModuleLoadData(ctypes.byref(module), compiled.asm["cubin"]))
    check(driver.cuModuleGetFunction(ctypes.byref(function), module, compiled.metadata.name.encode()))
    shared = compiled.metadata.shared
    if shared > DEFAULT_SHARED_BYTES:
        check(driver.cuFuncSetAttribute(function, MAX_DYNAMIC_SHARED_ATTRIBUTE, shared))
    return function, shared


def launch_binary(
    function: ctypes.c_void_p,
    shared: int,
    grid: Grid,
    num_threads: int,
    stream: int,
    arguments: Sequence[Tensor | int | float],
) -> None:
    """Launches a loaded kernel on a stream."""
    values: list[Any] = [
        ctypes.c_void_p(x.data_ptr()) if isinstance(x, Tensor) else C_TYPES[type(x)](x) for x in arguments
    ]
    values += [ctypes.c_void_p(0), ctypes.c_void_p(0)]  # Triton's scratch memory; these kernels use none
    pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
    blocks = (*grid, 1, 1)[:3]
    threads = num_threads, 1, 1
    check(load_driver().cuLaunchKernel(function, *blocks, *threads, shared, ctypes.c_void_p(stream), pointers, None))
