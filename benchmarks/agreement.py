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

from benchmarks.cases import Case, cases, versions
from benchmarks.methods import METHODS
from benchmarks.pictures import FIELDS
from benchmarks.tables import Row, Rows, named
from nerf_lightning.config.compose import composed
from nerf_lightning.training.train import train
from nerf_lightning.utils.device import CPU, synchronize

MAX_DIFFERENCE = 1e-4
"""Of floating numbers that count as equal, as a share of the largest of them."""
MAX_OTHERS = 1e-3
"""Share of whole numbers, or of samples, that may be others altogether."""
ROUNDS = 15
"""Calls of which the median time counts."""
STEPS = 400
SCENE = ("dataset=bricks", "dataset.size=64", "dataset.train_views=40", "dataset.val_views=4")
SMALL = ("dataset.samples=8192", "sampler.samples=96")
"""Steps that plain PyTorch takes in some hundredths of a second on a CPU."""
PICTURE = ("+experiment=picture", "dataset.max_side=128", "dataset.pixels=2048")
OFF = ("snapshots", "orbit", "checkpoints", "progress", "heldout")
PICTURE_OFF = ("pictures", "enlarge")
"""Callbacks that write what nobody looks at here."""
MAX_LOSS_DB = 0.3
"""How far the mean over seeds may be below the CPU's."""
MAX_SEEDS = 4
"""Runs of one seed are some 0.3 dB apart wherever chance or rounding differ, so that a first one below is no proof."""
FAILURES = (RuntimeError, TypeError)
"""How PyTorch says that a device cannot do something, or has no room for it."""


def failure(error: Exception) -> str:
    """A failure in one line."""
    return f"failed: {' '.join(str(error).split())[:200]}"


# Kernels


def largest(shares: list[float]) -> float:
    """The largest; not a number where one is not."""
    return float(torch.tensor(shares, dtype=torch.float64).max()) if shares else 0.0


def difference(got: Tensor, wanted: Tensor) -> float:
    """Largest difference as a share of the largest value wanted."""
    if got.shape != wanted.shape:
        return math.inf
    if not wanted.numel():
        return 0.0
    off, most = float((got.double() - wanted.double()).abs().max()), float(wanted.double().abs().max())
    return off / most if most else (0.0 if off == 0 else math.inf)


def others(got: Tensor, wanted: Tensor) -> float:
    """Share of whole numbers that differ, of those that are not zero."""
    if got.shape != wanted.shape:
        return 1.0
    return int((got != wanted).sum()) / max(1, int(((got != 0) | (wanted != 0)).sum()))


def compare_dense(got: list[Tensor], wanted: list[Tensor]) -> tuple[float, float]:
    """The largest difference of outputs, and the share of entries that are others: one by one."""
    pairs = list(zip(got, wanted, strict=True))
    return (
        largest([difference(a, b) for a, b in pairs if b.is_floating_point()]),
        largest([others(a, b) for a, b in pairs if not b.is_floating_point()]),
    )


def compare_located(got: list[Tensor], wanted: list[Tensor]) -> tuple[float, float]:
    """The same of rows [N, 8] and their weights, which are compared where the rows are the same."""
    if got[0].shape != wanted[0].shape:
        return math.inf, 1.0
    same = (got[0] == wanted[0]).all(1)
    return difference(got[1][same], wanted[1][same]), 1 - float(same.double().mean())


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
    met, lonely = off <= MAX_DIFFERENCE * longest, int((~(theirs <= MAX_DIFFERENCE * longest)).sum())
    lengths = difference(got[1][met], wanted[1][counterpart[met]])
    share = (int((~met).sum()) + lonely) / len(expected)
    return largest([*(off[met] / longest).tolist(), lengths]), share


def find_nearest(places: Tensor, among: Tensor) -> tuple[Tensor, Tensor]:
    """Distance to the nearest of ascending numbers, and which that is."""
    after = torch.searchsorted(among, places).clamp(0, len(among) - 1)
    before = (after - 1).clamp_min(0)
    which = torch.where((among[after] - places).abs() < (among[before] - places).abs(), after, before)
    return (among[which] - places).abs(), which


COMPARISONS = {"dense": compare_dense, "located": compare_located, "packed": compare_packed}


def random_like(outputs: list[Tensor]) -> list[Tensor]:
    """The same normal numbers on every device, laid out in memory as the outputs are."""
    generator = torch.Generator().manual_seed(7)
    return [torch.empty_like(x).copy_(torch.randn(x.shape, generator=generator)) for x in outputs]


def values_and_gradients(case: Case, device: torch.device, choice: str) -> tuple[list[Tensor], list[Tensor]]:
    """Brought to the CPU."""
    with versions(choice):
        inputs = case.on(device)
        values = case.outputs(inputs)
        gradients = case.gradients(inputs, values, random_like(values))
    return [x.detach().cpu() for x in values], [x.cpu() for x in gradients]


def milliseconds(case: Case, device: torch.device, choice: str) -> float:
    """Median time of one version of a kernel, with the gradient where it has one, after two calls to warm up."""
    times = []
    with versions(choice), torch.set_grad_enabled(case.learns > 0):
        inputs = case.on(device)
        above = random_like(case.outputs(inputs))
        for _ in range(2 + ROUNDS):
            synchronize(device)
            start = time.perf_counter()
            case.gradients(inputs, case.outputs(inputs), above)
            synchronize(device)
            times.append(time.perf_counter() - start)
    return 1e3 * median(times[2:])


def compare(case: Case, device: torch.device) -> Row:
    """A kernel on a device beside the reference on the CPU."""
    (values, gradients), (wanted, wanted_gradients) = (
        values_and_gradients(case, *version) for version in ((device, "auto"), (CPU, "reference"))
    )
    value, other = COMPARISONS[case.kind](values, wanted)
    gradient, _ = compare_dense(gradients, wanted_gradients)
    found = []
    if not value <= MAX_DIFFERENCE:
        found.append(f"value, {value:.1e} apart")
    if not other <= MAX_OTHERS:
        found.append(f"value, {100 * other:.3g}% of entries are others")
    if not gradient <= MAX_DIFFERENCE:
        found.append(f"gradient, {gradient:.1e} apart")
    ours, plain = (milliseconds(case, device, choice) for choice in ("auto", "reference"))
    apart = {"value_apart": value, "entries_other": other, "gradient_apart": gradient if case.learns else None}
    times = {"fast_ms": ours, "reference_ms": plain, "times_faster": plain / ours}
    return {**apart, **times, "differs": "; ".join(found)}


def compare_kernels(device: torch.device) -> Rows:
    """A line a kernel, on the work of one training step."""
    rows: Rows = []
    for name, case in cases().items():
        try:
            row = compare(case, device)
        except FAILURES as error:
            row = {"differs": failure(error)}
        rows.append({"kernel": name, **row})
        print(f"agreement: {name}: {row['differs'] or 'equal'}", flush=True)
    return rows


# Trainings


def short_trainings() -> dict[str, list[str]]:
    """Overrides of each method's short training."""
    off, picture_off = ([f"callbacks.{name}=null" for name in names] for names in (OFF, PICTURE_OFF))
    # As many rays a step on every device: with more it would learn more.
    common = [f"budget.steps={STEPS}", "limits.batch=1", "~logger", *off]
    return {
        **{name: [*SCENE, *SMALL, f"recipe={name}_medium", *common] for name in METHODS},
        **{name: [*PICTURE, f"model={name}", *common, *picture_off] for name in FIELDS},
    }


def train_quietly(overrides: list[str], kernels: str, seed: int, device: torch.device, folder: Path) -> float:
    """Held-out PSNR of a run in this process, which says nothing."""
    given = [*overrides, f"kernels={kernels}", f"seed={seed}", f"device={device.type}"]
    with versions(kernels), redirect_stdout(io.StringIO()):
        found: float | None = train(composed(given, folder), folder=folder)
    return math.nan if found is None else found


def compare_training(overrides: list[str], device: torch.device, seed: int, folder: Path) -> Row:
    """A method's mean PSNR on both; one seed more is asked as long as those before stand below the CPU."""
    there, here = [], []
    for one in range(seed, seed + MAX_SEEDS):
        there.append(train_quietly(overrides, "auto", one, device, folder / f"device_{one}"))
        here.append(train_quietly(overrides, "reference", one, CPU, folder / f"reference_{one}"))
        below = fmean(here) - fmean(there)
        if below <= MAX_LOSS_DB:
            break
    differs = "" if below <= MAX_LOSS_DB else f"{below:.2g} dB below the CPU"
    return {"psnr": fmean(there), "reference_psnr": fmean(here), "seeds": len(there), "differs": differs}


def compare_trainings(device: torch.device, seed: int, output: Path) -> Rows:
    """A line a method: whether it learns on a device as well as on the CPU with plain PyTorch, from the same seed."""
    rows: Rows = []
    for name, overrides in short_trainings().items():
        try:
            row = compare_training(overrides, device, seed, output / "trainings" / name)
        except FAILURES as error:
            row = {"differs": failure(error)}
        rows.append({"method": name, **row})
        print(f"agreement: {name}: {row['differs'] or 'equal'}", flush=True)
    return rows


def measure(args: argparse.Namespace) -> Rows:
    """Both tables."""
    trainings = compare_trainings(args.device, args.seeds[0], args.output)
    return named({"kernels": compare_kernels(args.device), "short trainings": trainings})
