"""Compiles GPU kernels for compute capabilities without a GPU, and launches one on a stub driver; prints what it finds as JSON.

A process of its own, as in the others Triton interprets.
"""

import ctypes
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import triton.backends.nvidia
from torch import Tensor

from nerf_lightning.kernels import set_kernels
from nerf_lightning.kernels.gpu import launch
from tests.helpers.gpu_kernel_calls import list_calls
from tests.helpers.kernel_comparison import values_and_gradients

CALLS = (
    "march, buffer with space",
    "filter_visible, buffer with space",
    "composite, thin",
    "hash_interpolate",
    "plane_line_products",
    "plane_line_sum",
    "interval_midpoints",
    "resample, as many as fit",
    "volume_weights",
    "proposal_weights",
    "interlevel_loss",
    "weight_losses",
    "mlp, one hidden layer",
    "mlp, two hidden layers",
    "mlp, exponential",
    "mlp, sigmoid",
    "plane_line_sum, exponential",
    "locate_samples",
    "photometric_loss",
)
CAPABILITIES = [int(capability) for capability in sys.argv[1:]]
CUOBJDUMP = Path(triton.backends.nvidia.__file__).parent / "bin" / "cuobjdump"
USAGE = re.compile(r"REG:(\d+) STACK:(\d+) SHARED:(\d+) LOCAL:(\d+)")
PTX_TYPES = {"u64": ctypes.c_uint64, "u32": ctypes.c_int32, "f32": ctypes.c_float}
LAUNCHED = "march.march_rays"
GRID, STREAM = (3, 2), 7


def measure_usage(cubin: bytes) -> dict[str, int]:
    """Registers and memory of a thread, shared memory of a program."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        command = [str(CUOBJDUMP), "--dump-resource-usage", file.name]
        usage = USAGE.search(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert usage is not None
    return dict(zip(("registers", "stack", "shared", "local"), map(int, usage.groups()), strict=True))


class StubDriver:
    """The CUDA driver, as far as a launch asks for it. Reads arguments as the kernel's PTX declares them."""

    def __init__(self, ptx: str):
        self.types = [PTX_TYPES[name] for name in re.findall(r"\.param \.(u64|u32|f32)", ptx)]
        self.values: list[int | float] = []
        self.launch: list[int] = []

    def cuModuleLoadData(self, module: Any, cubin: bytes) -> int:
        assert cubin[:4] == b"\x7fELF"
        return 0

    def cuModuleGetFunction(self, function: Any, module: Any, name: bytes) -> int:
        return 0

    def cuLaunchKernel(self, function: Any, *rest: Any) -> int:
        *self.launch, stream, pointers, _ = rest
        self.launch.append(stream.value)
        self.values = [kind.from_address(pointers[i]).value for i, kind in enumerate(self.types)]
        return 0


def launch_on_stub(compiled: Any, num_warps: int, arguments: Sequence[Tensor | int | float]) -> dict[str, Any]:
    driver = StubDriver(compiled.asm["ptx"])
    launch.load_driver = lambda: driver
    launch.launch_binary(*launch.load_binary(compiled), GRID, 32 * num_warps, STREAM, arguments)
    expected = [x.data_ptr() if isinstance(x, Tensor) else x for x in arguments]
    return {
        "values": driver.values,
        "expected": [*expected, 0, 0],
        "launch": driver.launch,
        "shared": compiled.metadata.shared,
    }


def main() -> None:
    usage, stub = dict[str, dict[int, dict[str, int]]](), dict[str, Any]()

    def compile_only(kernel: launch.Kernel, grid: Any, arguments: Any, constants: Any) -> None:
        for capability in (c for c in CAPABILITIES if c >= 80 or not kernel.name.startswith("mlp.")):
            compiled = kernel.compile(capability, arguments, constants)
            measured, most = measure_usage(compiled.asm["cubin"]), usage.setdefault(kernel.name, {})
            most[capability] = {name: max(n, most.get(capability, {}).get(name, 0)) for name, n in measured.items()}
        if kernel.name == LAUNCHED:
            stub.update(launch_on_stub(compiled, kernel.num_warps, arguments))

    launch.run_kernel = compile_only
    set_kernels("triton")
    calls = list_calls()
    for name in CALLS:
        values_and_gradients(*calls[name])
    print(json.dumps({"usage": usage, "stub": stub}))


if __name__ == "__main__":
    main()
