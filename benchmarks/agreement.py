"""Whether kernels and trainings on a device give what plain PyTorch gives on the CPU, and how long kernels take.

Versions and devices add up in another order, and round otherwise where a product and a sum become one operation: a single
number may be off by some 1e-7 of the numbers it is made of, a sum over thousands by some 1e-5 of the largest. What is wrong
is off by far more: half precision by 1e-3, a forgotten sample or corner by 1e-2 and more. Where a position lies on a border of
cells to the last bit, rounding decides which cell it is in: few entries may be others altogether.
"""

import argparse
import io
import math
import time
from contextlib import redirect_stdout
from pathlib import Path
from statistics import fmean, median

import torch
from torch import Tensor

from benchmarks.image_fields import FIELDS
from benchmarks.kernel_cases import Case, kernel_version, make_cases
from benchmarks.methods import METHODS
from benchmarks.tables import Row, Rows, name_tables
from nerf_lightning.config.compose import compose_config
from nerf_lightning.training.train import train
from nerf_lightning.utils.device import CPU, synchronize

MAX_RELATIVE_ERROR = 1e-4
"""Of floating numbers that count as equal, as a share of the largest of them."""
MAX_MISMATCH_RATIO = 1e-3
"""Share of whole numbers, or of samples, that may be others altogether."""
TIMED_CALLS = 15
"""Calls of which the median time counts."""
STEPS = 400
SCENE = ("dataset=bricks", "dataset.size=64", "dataset.train_views=40", "dataset.val_views=4")
SMALL_BATCH = ("dataset.samples=8192", "sampler.samples=96")
"""Steps that plain PyTorch takes in some hundredths of a second on a CPU."""
IMAGE = ("+experiment=picture", "dataset.max_side=128", "dataset.pixels=2048")
DISABLED_CALLBACKS = ("snapshots", "orbit", "checkpoints", "progress", "validation")
DISABLED_IMAGE_CALLBACKS = ("pictures", "upscale")
"""Callbacks that write what nobody looks at here."""
MAX_LOSS_DB = 0.3
"""How far the mean over seeds may be below the CPU's."""
MAX_SEEDS = 4
"""Runs of one seed are some 0.3 dB apart wherever chance or rounding differ, so that a first one below is no proof."""
DEVICE_ERRORS = (RuntimeError, TypeError)
"""How PyTorch says that a device cannot do something, or has no room for it."""


def describe_failure(error: Exception) -> str:
    """A failure in one line."""
    return f"failed: {' '.join(str(error).split())[:200]}"


# Kernels


def nan_max(shares: list[float]) -> float:
    """The largest; not a number where one is not."""
    return float(torch.tensor(shares, dtype=torch.float64).max()) if shares else 0.0


def compute_relative_error(got: Tensor, wanted: Tensor) -> float:
    """Largest difference as a share of the largest value wanted."""
    if got.shape != wanted.shape:
        return math.inf
    if not wanted.numel():
        return 0.0
    off, most = float((got.double() - wanted.double()).abs().max()), float(wanted.double().abs().max())
    return off / most if most else (0.0 if off == 0 else math.inf)


def compute_mismatch_ratio(got: Tensor, wanted: Tensor) -> float:
    """Share of whole numbers that differ, of those that are not zero."""
    if got.shape != wanted.shape:
        return 1.0
    return int((got != wanted).sum()) / max(1, int(((got != 0) | (wanted != 0)).sum()))


def compare_dense(got: list[Tensor], wanted: list[Tensor]) -> tuple[float, float]:
    """The largest difference of outputs, and the share of entries that are others: one by one."""
    pairs = list(zip(got, wanted, strict=True))
    return (
        nan_max([compute_relative_error(a, b) for a, b in pairs if b.is_floating_point()]),
        nan_max([compute_mismatch_ratio(a, b) for a, b in pairs if not b.is_floating_point()]),
    )


def compare_rows(got: list[Tensor], wanted: list[Tensor]) -> tuple[float, float]:
    """The same of rows [N, 8] and their weights, which are compared where the rows are the same."""
    if got[0].shape != wanted[0].shape:
        return math.inf, 1.0
    same = (got[0] == wanted[0]).all(1)
    return compute_relative_error(got[1][same], wanted[1][same]), 1 - float(same.double().mean())


def compare_packed(got: list[Tensor], wanted: list[Tensor]) -> tuple[float, float]:
    """The same of samples; others are those without a counterpart on their ray. What only fills up room is left out."""
    got, wanted = ([*(x[: int(offsets[-1])] for x in parts), offsets] for *parts, offsets in (got, wanted))
    longest = max((float(x[0].max()) for x in (got, wanted) if len(x[0])), default=1.0)
    for _, _, ray, offsets in (got, wanted):
        if not torch.equal(offsets[1:], torch.bincount(ray, minlength=len(offsets) - 1).cumsum(0)):
            return math.inf, 1.0
    places, expected = (3 * longest * ray.double() + t.double() for t, _, ray, _ in (got, wanted))
    if not (len(places) and len(expected)):
        return 0.0, float(len(places) != len(expected))
    (off, counterpart), (theirs, _) = find_nearest(places, expected), find_nearest(expected, places)
    met, lonely = off <= MAX_RELATIVE_ERROR * longest, int((~(theirs <= MAX_RELATIVE_ERROR * longest)).sum())
    lengths = compute_relative_error(got[1][met], wanted[1][counterpart[met]])
    share = (int((~met).sum()) + lonely) / len(expected)
    return nan_max([*(off[met] / longest).tolist(), lengths]), share


def find_nearest(places: Tensor, among: Tensor) -> tuple[Tensor, Tensor]:
    """Distance to the nearest of ascending numbers, and which that is."""
    after = torch.searchsorted(among, places).clamp(0, len(among) - 1)
    before = (after - 1).clamp_min(0)
    which = torch.where((among[after] - places).abs() < (among[before] - places).abs(), after, before)
    return (among[which] - places).abs(), which


COMPARISONS = {"dense": compare_dense, "rows": compare_rows, "packed": compare_packed}


def make_random_like(outputs: list[Tensor]) -> list[Tensor]:
    """The same normal numbers on every device, laid out in memory as the outputs are."""
    generator = torch.Generator().manual_seed(7)
    return [torch.empty_like(x).copy_(torch.randn(x.shape, generator=generator)) for x in outputs]


def run_case(case: Case, device: torch.device, choice: str) -> tuple[list[Tensor], list[Tensor]]:
    """Brought to the CPU."""
    with kernel_version(choice):
        inputs = case.to_device(device)
        values = case.outputs(inputs)
        gradients = case.gradients(inputs, values, make_random_like(values))
    return [x.detach().cpu() for x in values], [x.cpu() for x in gradients]


def time_case(case: Case, device: torch.device, choice: str) -> float:
    """Median time of one version of a kernel, with the gradient where it has one, after two calls to warm up."""
    times = []
    with kernel_version(choice), torch.set_grad_enabled(case.num_trainable > 0):
        inputs = case.to_device(device)
        above = make_random_like(case.outputs(inputs))
        for _ in range(2 + TIMED_CALLS):
            synchronize(device)
            start = time.perf_counter()
            case.gradients(inputs, case.outputs(inputs), above)
            synchronize(device)
            times.append(time.perf_counter() - start)
    return 1e3 * median(times[2:])


def compare_kernel(case: Case, device: torch.device) -> Row:
    """A kernel on a device beside the reference on the CPU."""
    (values, gradients), (wanted, wanted_gradients) = (
        run_case(case, *version) for version in ((device, "auto"), (CPU, "reference"))
    )
    value, other = COMPARISONS[case.kind](values, wanted)
    gradient, _ = compare_dense(gradients, wanted_gradients)
    found = []
    if not value <= MAX_RELATIVE_ERROR:
        found.append(f"value, {value:.1e} apart")
    if not other <= MAX_MISMATCH_RATIO:
        found.append(f"value, {100 * other:.3g}% of entries are others")
    if not gradient <= MAX_RELATIVE_ERROR:
        found.append(f"gradient, {gradient:.1e} apart")
    ours, plain = (time_case(case, device, choice) for choice in ("auto", "reference"))
    apart = {"value_apart": value, "entries_other": other, "gradient_apart": gradient if case.num_trainable else None}
    times = {"fast_ms": ours, "reference_ms": plain, "times_faster": plain / ours}
    return {**apart, **times, "differs": "; ".join(found)}


def compare_kernels(device: torch.device) -> Rows:
    """A line a kernel, on the work of one training step."""
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
    """Overrides of each method's short training."""
    off, picture_off = (
        [f"callbacks.{name}=null" for name in names] for names in (DISABLED_CALLBACKS, DISABLED_IMAGE_CALLBACKS)
    )
    # As many rays a step on every device: with more it would learn more.
    common = [f"budget.steps={STEPS}", "limits.batch_scale=1", "~logger", *off]
    return {
        **{name: [*SCENE, *SMALL_BATCH, f"recipe={name}_medium", *common] for name in METHODS},
        **{name: [*IMAGE, f"model={name}", *common, *picture_off] for name in FIELDS},
    }


def train_silently(overrides: list[str], kernels: str, seed: int, device: torch.device, folder: Path) -> float:
    """Held-out PSNR of a run in this process, which says nothing."""
    given = [*overrides, f"kernels={kernels}", f"seed={seed}", f"device={device.type}"]
    with kernel_version(kernels), redirect_stdout(io.StringIO()):
        found: float | None = train(compose_config(given, folder), folder=folder)
    return math.nan if found is None else found


def compare_training(overrides: list[str], device: torch.device, seed: int, folder: Path) -> Row:
    """A method's mean PSNR on both; one seed more is asked as long as those before stand below the CPU."""
    there, here = [], []
    for one in range(seed, seed + MAX_SEEDS):
        there.append(train_silently(overrides, "auto", one, device, folder / f"device_{one}"))
        here.append(train_silently(overrides, "reference", one, CPU, folder / f"reference_{one}"))
        below = fmean(here) - fmean(there)
        if below <= MAX_LOSS_DB:
            break
    differs = "" if below <= MAX_LOSS_DB else f"{below:.2g} dB below the CPU"
    return {"psnr": fmean(there), "reference_psnr": fmean(here), "seeds": len(there), "differs": differs}


def compare_trainings(device: torch.device, seed: int, output: Path) -> Rows:
    """A line a method: whether it learns on a device as well as on the CPU with plain PyTorch, from the same seed."""
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
    """Both tables."""
    trainings = compare_trainings(args.device, args.seeds[0], args.output)
    return name_tables({"kernels": compare_kernels(args.device), "short trainings": trainings})
