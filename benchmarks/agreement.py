"""Agreement of kernels and trainings on a device with plain PyTorch on the CPU.

Kernel versions and devices differ in summation order and fused multiply-adds: by about 1e-7 relative in a single number, 1e-5
in a sum over thousands. Errors are far larger: half precision gives 1e-3, a missing sample or corner 1e-2 and more. Where a
position lies exactly on a cell border, rounding decides its cell: a few entries may differ entirely.
"""

import argparse
import io
import math
from contextlib import redirect_stdout
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from benchmarks.image_fields import FIELDS
from benchmarks.kernel_cases import Case, kernel_version, make_cases
from benchmarks.methods import METHODS
from benchmarks.tables import Row, Rows, name_tables
from nerf_lightning.config.compose import compose_config
from nerf_lightning.training.train import train
from nerf_lightning.utils.device import CPU

MAX_RELATIVE_ERROR = 1e-4
"""Largest difference of floats that count as equal, relative to the largest of them."""
MAX_MISMATCH_RATIO = 1e-3
"""Largest fraction of integers or samples that may differ entirely."""
STEPS = 400
SCENE = ("dataset=bricks", "dataset.size=64", "dataset.train_views=40", "dataset.val_views=4")
SMALL_BATCH = ("dataset.samples=8192", "sampler.samples=96")
"""A batch that plain PyTorch processes in some 10 ms on a CPU."""
IMAGE = ("+experiment=picture", "dataset.max_side=128", "dataset.pixels=2048")
DISABLED = (
    "~logger",
    *(f"callbacks.{x}=null" for x in ("snapshots", "orbit", "checkpoints", "progress", "validation")),
)
IMAGE_DISABLED = ("callbacks.pictures=null", "callbacks.upscale=null")
"""The logger, and callbacks whose output is not needed here."""
MAX_LOSS_DB = 0.3
"""Largest loss of PSNR against the CPU, in the mean over seeds."""
MAX_SEEDS = 4
"""Most seeds: rounding alone changes a run's PSNR by some 0.3 dB, so that one bad run proves nothing."""
DEVICE_ERRORS = (RuntimeError, TypeError)
"""Errors of PyTorch for unsupported operations and exhausted device memory."""


def describe_failure(error: BaseException) -> str:
    """Formats an error in one line."""
    return f"failed: {' '.join(str(error).split())[:200]}"


# Kernels


def nan_max(values: list[float]) -> float:
    """Largest value; nan if any is nan, 0 if there is none."""
    return float(torch.tensor(values, dtype=torch.float64).max()) if values else 0.0


def compute_relative_error(actual: Tensor, expected: Tensor) -> float:
    """Largest absolute difference relative to the largest expected value."""
    if actual.shape != expected.shape:
        return math.inf
    if not expected.numel():
        return 0.0
    error, largest = float((actual.double() - expected.double()).abs().max()), float(expected.double().abs().max())
    return error / largest if largest else (0.0 if error == 0 else math.inf)


def compute_mismatch_ratio(actual: Tensor, expected: Tensor) -> float:
    """Fraction of integers that differ, among those that are nonzero in either tensor."""
    if actual.shape != expected.shape:
        return 1.0
    return int((actual != expected).sum()) / max(1, int(((actual != 0) | (expected != 0)).sum()))


def compare_dense(actual: list[Tensor], expected: list[Tensor]) -> tuple[float, float]:
    """Relative error and mismatch ratio of dense outputs, elementwise."""
    pairs = list(zip(actual, expected, strict=True))
    errors = [compute_relative_error(a, b) for a, b in pairs if b.is_floating_point()]
    return nan_max(errors), nan_max([compute_mismatch_ratio(a, b) for a, b in pairs if not b.is_floating_point()])


def compare_rows(actual: list[Tensor], expected: list[Tensor]) -> tuple[float, float]:
    """Mismatch ratio of rows [N, 8], and relative error of their weights where the rows agree."""
    if actual[0].shape != expected[0].shape:
        return math.inf, 1.0
    same = (actual[0] == expected[0]).all(1)
    return compute_relative_error(actual[1][same], expected[1][same]), 1 - float(same.double().mean())


def compare_packed(actual: list[Tensor], expected: list[Tensor]) -> tuple[float, float]:
    """Mismatch ratio of packed samples (no counterpart on their ray), and relative error of the others, within capacity."""
    actual, expected = ([*(x[: int(offsets[-1])] for x in parts), offsets] for *parts, offsets in (actual, expected))
    longest = max((float(x[0].max()) for x in (actual, expected) if len(x[0])), default=1.0)
    for _, _, ray, offsets in (actual, expected):
        if not torch.equal(offsets[1:], torch.bincount(ray, minlength=len(offsets) - 1).cumsum(0)):
            return math.inf, 1.0
    keys, expected_keys = (3 * longest * ray.double() + t.double() for t, _, ray, _ in (actual, expected))
    if not (len(keys) and len(expected_keys)):
        return 0.0, float(len(keys) != len(expected_keys))
    (error, index), (reverse_error, _) = find_nearest(keys, expected_keys), find_nearest(expected_keys, keys)
    matched, covered = (distance <= MAX_RELATIVE_ERROR * longest for distance in (error, reverse_error))
    lengths = compute_relative_error(actual[1][matched], expected[1][index[matched]])
    mismatch = (int((~matched).sum()) + int((~covered).sum())) / len(expected_keys)
    return nan_max([*(error[matched] / longest).tolist(), lengths]), mismatch


def find_nearest(values: Tensor, sorted_values: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of each value to the nearest of the sorted ones, and its index."""
    after = torch.searchsorted(sorted_values, values).clamp(0, len(sorted_values) - 1)
    before = (after - 1).clamp_min(0)
    nearest = torch.where((sorted_values[after] - values).abs() < (sorted_values[before] - values).abs(), after, before)
    return (sorted_values[nearest] - values).abs(), nearest


COMPARISONS = {"dense": compare_dense, "rows": compare_rows, "packed": compare_packed}


def make_random_like(outputs: list[Tensor]) -> list[Tensor]:
    """Random normal tensors, the same on every device, with the outputs' memory layout."""
    generator = torch.Generator().manual_seed(7)
    return [torch.empty_like(x).copy_(torch.randn(x.shape, generator=generator)) for x in outputs]


def run_case(case: Case, device: torch.device, choice: str) -> tuple[list[Tensor], list[Tensor]]:
    """Runs a version of a kernel and returns outputs and gradients on the CPU."""
    with kernel_version(choice):
        inputs = case.to_device(device)
        values = case.outputs(inputs)
        gradients = case.gradients(inputs, values, make_random_like(values))
    return [x.detach().cpu() for x in values], [x.cpu() for x in gradients]


def compare_kernel(case: Case, device: torch.device) -> Row:
    """Compares a kernel on a device with the reference on the CPU."""
    values, gradients = run_case(case, device, "auto")
    expected, expected_gradients = run_case(case, CPU, "reference")
    error, mismatch = COMPARISONS[case.kind](values, expected)
    gradient, _ = compare_dense(gradients, expected_gradients)
    problems = []
    if not error <= MAX_RELATIVE_ERROR:
        problems.append(f"value error {error:.1e}")
    if not mismatch <= MAX_MISMATCH_RATIO:
        problems.append(f"{100 * mismatch:.3g}% of entries mismatch")
    if not gradient <= MAX_RELATIVE_ERROR:
        problems.append(f"gradient error {gradient:.1e}")
    errors = {"value_error": error, "mismatch_ratio": mismatch}
    return {**errors, "gradient_error": gradient if case.num_trainable else None, "differs": "; ".join(problems)}


def compare_kernels(device: torch.device) -> Rows:
    """Compares all kernels, one row each, on the inputs of one training step."""
    rows: Rows = []
    for name, case in make_cases().items():
        try:
            row = compare_kernel(case, device)
        except DEVICE_ERRORS as error:
            row = {"differs": describe_failure(error)}
        rows.append({"kernel": name, **row})
        print(f"agreement: {name}: {row['differs'] or 'equal'}", flush=True)
    return rows


# Trainings


def list_short_trainings() -> dict[str, list[str]]:
    """Overrides for a short training of each method."""
    # The same batch size on every device: a larger one would learn more.
    common = [f"budget.steps={STEPS}", "limits.batch_scale=1", *DISABLED]
    scenes = {name: [*SCENE, *SMALL_BATCH, f"recipe={name}_medium", *common] for name in METHODS}
    return scenes | {name: [*IMAGE, f"model={name}", *common, *IMAGE_DISABLED] for name in FIELDS}


def train_silently(overrides: list[str], kernels: str, seed: int, device: torch.device, folder: Path) -> float:
    """Trains in this process without output and returns the held-out PSNR."""
    options = [*overrides, f"kernels={kernels}", f"seed={seed}", f"device={device.type}"]
    with kernel_version(kernels), redirect_stdout(io.StringIO()):
        psnr: float | None = train(compose_config(options, folder), folder=folder)
    return math.nan if psnr is None else psnr


def compare_training(overrides: list[str], device: torch.device, seed: int, folder: Path) -> Row:
    """Compares a method's mean PSNR on both devices, adding seeds while the device is worse."""
    ours, cpu = [], []
    for run_seed in range(seed, seed + MAX_SEEDS):
        ours.append(train_silently(overrides, "auto", run_seed, device, folder / f"device_{run_seed}"))
        cpu.append(train_silently(overrides, "reference", run_seed, CPU, folder / f"reference_{run_seed}"))
        loss = fmean(cpu) - fmean(ours)
        if loss <= MAX_LOSS_DB:
            break
    differs = "" if loss <= MAX_LOSS_DB else f"{loss:.2g} dB below the CPU"
    return {"psnr": fmean(ours), "reference_psnr": fmean(cpu), "seeds": len(ours), "differs": differs}


def compare_trainings(device: torch.device, seed: int, output: Path) -> Rows:
    """Compares short trainings, one row per method, with the CPU and plain PyTorch, from the same seeds."""
    rows: Rows = []
    for name, overrides in list_short_trainings().items():
        try:
            row = compare_training(overrides, device, seed, output / "trainings" / name)
        except DEVICE_ERRORS as error:
            row = {"differs": describe_failure(error)}
        rows.append({"method": name, **row})
        print(f"agreement: {name}: {row['differs'] or 'equal'}", flush=True)
    return rows


def measure(args: argparse.Namespace) -> Rows:
    """Measures both tables."""
    trainings = compare_trainings(args.device, args.seeds[0], args.output)
    return name_tables({"kernels": compare_kernels(args.device), "short trainings": trainings})
