"""Kernels for GPUs: in Triton's interpreter against the reference, and compiled for cards that are not here."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import _disable_current_modes

pytest.importorskip("triton", "3.3", reason="the extra `test` installs triton on Linux")

from benchmarks.op_counter import OpCounter  # noqa: E402
from nerf_lightning.kernels import gpu, set_kernels  # noqa: E402
from nerf_lightning.kernels.gpu import launch, self_test  # noqa: E402
from nerf_lightning.system.system import sum_losses  # noqa: E402
from nerf_lightning.utils.seeding import Stream, step_generator  # noqa: E402
from tests.helpers.fake_device import FakeTensor  # noqa: E402
from tests.helpers.gpu_kernel_calls import list_calls  # noqa: E402
from tests.helpers.kernel_comparison import values_and_gradients  # noqa: E402
from tests.helpers.train_models import SMALL_BRICKS  # noqa: E402
from tests.test_any_device import build_capture, build_system_and_data, train_steps  # noqa: E402

CALLS = list_calls()
MAX_REGISTERS = 128
"""A multiprocessor of 65,536 registers then holds 16 warps."""


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The names of the kernels that run."""
    names, run = [], launch.run_kernel

    def run_and_note(kernel: launch.Kernel, grid: Any, arguments: Any, constants: Any) -> None:
        names.append(kernel.name)
        on_cpu = [x.cpu_tensor if isinstance(x, FakeTensor) else x for x in arguments]
        with _disable_current_modes():  # the interpreter's operations are no launches
            run(kernel, grid, on_cpu, constants)

    monkeypatch.setattr(launch, "run_kernel", run_and_note)
    yield names
    set_kernels("auto")


@pytest.mark.parametrize("name", CALLS)
def test_kernel_matches_reference(name: str, launched: list[str]):
    arguments = CALLS[name]
    set_kernels("reference")
    expected = values_and_gradients(*arguments)
    assert not launched
    set_kernels("triton")
    actual = values_and_gradients(*arguments)
    assert launched and len(actual) == len(expected)
    for got, wanted in zip(actual, expected, strict=True):
        scale = max(float(wanted.nan_to_num().abs().max()), 1.0) if wanted.numel() else 1.0
        torch.testing.assert_close(got, wanted, rtol=1e-5, atol=2e-6 * scale, equal_nan=True)


@pytest.fixture(scope="module", params=["80", pytest.param("75 90", marks=pytest.mark.long)])
def compiled(request: pytest.FixtureRequest) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.helpers.compile_gpu_kernels", *request.param.split()]
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert not done.returncode, done.stderr
    return {"capabilities": set(request.param.split()), **json.loads(done.stdout.splitlines()[-1])}


def test_kernels_compile_without_spills(compiled: dict[str, Any]):
    assert len(compiled["usage"]) == 19
    for name, by_capability in compiled["usage"].items():
        assert by_capability.keys() == compiled["capabilities"] - ({"75"} if name.startswith("mlp.") else set())
        for capability, counts in by_capability.items():
            assert counts["local"] == counts["stack"] == 0, (name, capability)
            # Networks keep whole layers in registers.
            assert name.startswith("mlp.") or counts["registers"] <= MAX_REGISTERS, (name, capability)


def test_launch_passes_arguments_in_order_to_driver(compiled: dict[str, Any]):
    stub = compiled["stub"]
    assert stub["values"] == pytest.approx(stub["expected"])
    assert stub["launch"] == [3, 2, 1, 128, 1, 1, stub["shared"], 7]  # grid, threads, shared memory, stream


def test_self_test_finds_wrong_or_failing_kernel(monkeypatch: pytest.MonkeyPatch):
    for name, value in {"NUM_RAYS": 20, "CAPACITY": 300, "NUM_POSITIONS": 40}.items():
        monkeypatch.setattr(self_test, name, value)
    assert not self_test.find_failure(torch.device("cpu"))
    monkeypatch.setattr(
        gpu.composite.Composite, "backward", lambda ctx, *grads: (*ctx.saved_tensors[:2], None, None, None)
    )
    assert self_test.find_failure(torch.device("cpu")).startswith("composite differs from the reference by")
    monkeypatch.setattr(gpu.march, "march", lambda *inputs: 1 / 0)
    assert self_test.find_failure(torch.device("cpu")) == "march: ZeroDivisionError: division by zero"


NUM_STEPS = [3, pytest.param(20, marks=pytest.mark.long)]


@pytest.mark.parametrize("steps", NUM_STEPS)
@pytest.mark.parametrize(
    ("recipe", "model"),
    [
        ("hashgrid_small", ["model.num_levels=3"]),
        ("tensorf_small", ["model.base_resolution=12", "model.max_resolution=20"]),
    ],
)
def test_training_on_gpu_kernels_matches_reference(
    recipe: str, model: list[str], steps: int, launched: list[str], tmp_path: Path
):
    small = [*SMALL_BRICKS, "dataset.samples=null"]
    options = [f"recipe={recipe}", *model, *small, "dataset.rays=6", "sampler.resolution=8", "+sampler.samples=24"]
    losses: dict[str, list[float]] = {}
    for choice in ("reference", "triton"):
        torch.manual_seed(0)
        set_kernels("auto")
        system, data = build_system_and_data(options, tmp_path)
        set_kernels(choice)
        losses[choice] = train_steps(system, data, steps, torch.device("cpu"))
    assert losses["triton"] == pytest.approx(losses["reference"], rel=1e-5)
    assert launched.count("composite.differentiate_rays") == steps


MAX_LAUNCHES = {"hashgrid": 45, "tensorf": 41}
"""Kernels of a step, torch's and ours, without the draw of its rays."""


def count_launches(system: Any, data: Any, steps: tuple[int, ...], device: torch.device) -> OpCounter:
    """The counts of the last of some training steps; the first ones make what is then kept."""
    optimizer = system.to(device).configure_optimizers()
    set_kernels("triton")
    for step in steps:
        batch, generator = data.draw(step).to(device), step_generator(0, Stream.STEP, step, device)
        with OpCounter() as count:
            system.sampler.update(step, system.field.density, generator)
            sum_losses(system.compute_losses(batch, generator)[0]).backward()
            optimizer.step()
            optimizer.zero_grad()
    return count


@pytest.mark.parametrize("name", MAX_LAUNCHES)
def test_training_step_on_gpu_kernels_needs_few_launches(
    name: str, launched: list[str], device: torch.device, tmp_path: Path
):
    """Counts the second step after an update, whose buffers are of fixed size."""
    small = [*SMALL_BRICKS, "dataset.rays=6", "sampler.resolution=8", "+sampler.samples=24", "sampler.warmup=0"]
    count = count_launches(*build_system_and_data([f"recipe={name}_small", *small], tmp_path), (1, 2), device)
    assert 20 < count.operations <= MAX_LAUNCHES[name], count.names
    assert not count.waits


@pytest.mark.parametrize("steps", NUM_STEPS)
def test_capture_training_on_gpu_kernels_matches_reference(steps: int, launched: list[str], tmp_path: Path):
    proposals = ["sampler=proposal", "sampler.samples=5", "sampler.coarse_samples=9", "sampler.fine_samples=6"]
    losses = {}
    for choice in ("reference", "triton"):
        torch.manual_seed(0)
        system, data = build_capture([*proposals, *SMALL_GRID, "optimizer.lr=0.003"], 2, tmp_path)
        set_kernels(choice)
        losses[choice] = train_steps(system, data, steps, torch.device("cpu"))
    assert losses["triton"] == pytest.approx(losses["reference"], rel=1e-5)
    assert launched.count("resampling.bound_weights") == 2 * steps


SMALL_GRID = ["model.num_levels=2", "model.max_resolution=32", "model.log2_hashmap_size=8"]
MAX_CAPTURE_LAUNCHES = 102
"""Launches of a capture's training step."""


def test_capture_step_on_device_needs_few_launches(launched: list[str], device: torch.device, tmp_path: Path):
    count = count_launches(*build_capture(SMALL_GRID, 4, tmp_path), (0, 1), device)
    assert count.waits == 0
    assert 20 < count.operations <= MAX_CAPTURE_LAUNCHES, count.names
