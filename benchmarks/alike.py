"""Whether a device's kernels give what the plain-torch reference gives on the CPU: values and gradients, and how long it takes.

Versions and devices add up in another order, and round otherwise where a product and a sum become one operation: a single
number may be off by some 1e-7 of the numbers it is made of, a sum over thousands by some 1e-5 of the largest. What is wrong
is off by far more: half precision by 1e-3, a forgotten sample or corner by 1e-2 and more. Where a position lies on a border of
cells to the last bit, rounding decides which cell it is in: few entries may be others altogether.
"""

import math
from typing import Any

import torch
from torch import Tensor

from benchmarks.cases import Case, cases, versions
from benchmarks.kernels import case_milliseconds, random_like
from nerf_lightning.utils.device import CPU

APART = 1e-4
"""Largest difference of floating numbers that counts as equal, as a share of the largest of them."""
OTHERS = 1e-3
"""Share of whole numbers, or of samples, that may be others altogether."""

FAILURES = (RuntimeError, TypeError)
"""How torch says that a device cannot do something, or has no room for it."""

Rows = list[dict[str, Any]]


def told(error: Exception) -> str:
    """A failure in one line."""
    return f"failed: {' '.join(str(error).split())[:200]}"


def worst(shares: list[float]) -> float:
    """The largest; not a number where one is not."""
    return float(torch.tensor(shares, dtype=torch.float64).max()) if shares else 0.0


def apart(got: Tensor, wanted: Tensor) -> float:
    """Largest difference as a share of the largest value wanted."""
    if got.shape != wanted.shape:
        return math.inf
    if not wanted.numel():
        return 0.0
    off, largest = float((got.double() - wanted.double()).abs().max()), float(wanted.double().abs().max())
    return off / largest if largest else (0.0 if off == 0 else math.inf)


def others(got: Tensor, wanted: Tensor) -> float:
    """Share of whole numbers that differ, of those that are not zero."""
    if got.shape != wanted.shape:
        return 1.0
    return int((got != wanted).sum()) / max(1, int(((got != 0) | (wanted != 0)).sum()))


def dense(got: list[Tensor], wanted: list[Tensor]) -> tuple[float, float]:
    """How far outputs are apart, and the share of entries that are others: one by one."""
    pairs = list(zip(got, wanted, strict=True))
    return (
        worst([apart(a, b) for a, b in pairs if b.is_floating_point()]),
        worst([others(a, b) for a, b in pairs if not b.is_floating_point()]),
    )


def located(got: list[Tensor], wanted: list[Tensor]) -> tuple[float, float]:
    """The same of rows [N, 8] and their weights, which are compared where the rows are the same."""
    if got[0].shape != wanted[0].shape:
        return math.inf, 1.0
    same = (got[0] == wanted[0]).all(1)
    return apart(got[1][same], wanted[1][same]), 1 - float(same.double().mean())


def packed(got: list[Tensor], wanted: list[Tensor]) -> tuple[float, float]:
    """The same of samples, those being others that have no counterpart on their ray; what only fills up room is left out."""
    got, wanted = ([*(x[: int(offsets[-1])] for x in parts), offsets] for *parts, offsets in (got, wanted))
    longest = max((float(x[0].max()) for x in (got, wanted) if len(x[0])), default=1.0)
    places, counts = [], []
    for t, _, ray, offsets in (got, wanted):
        places.append(3 * longest * ray.double() + t.double())
        counts.append(torch.bincount(ray, minlength=len(offsets) - 1).cumsum(0))
    if not all(torch.equal(x[3][1:], count) for x, count in zip((got, wanted), counts, strict=True)):
        return math.inf, 1.0
    if not (len(places[0]) and len(places[1])):
        return 0.0, float(len(places[0]) != len(places[1]))
    (off, counterpart), (theirs, _) = _nearest(places[0], places[1]), _nearest(places[1], places[0])
    met, lonely = off <= APART * longest, int((~(theirs <= APART * longest)).sum())
    lengths = apart(got[1][met], wanted[1][counterpart[met]])
    share = (int((~met).sum()) + lonely) / len(places[1])
    return worst([*(off[met] / longest).tolist(), lengths]), share


def _nearest(places: Tensor, among: Tensor) -> tuple[Tensor, Tensor]:
    """Distance to the nearest of ascending numbers, and which that is."""
    after = torch.searchsorted(among, places).clamp(0, len(among) - 1)
    before = (after - 1).clamp_min(0)
    which = torch.where((among[after] - places).abs() < (among[before] - places).abs(), after, before)
    return (among[which] - places).abs(), which


KINDS = {"dense": dense, "located": located, "packed": packed}


def outcome(case: Case, device: torch.device, choice: str) -> tuple[list[Tensor], list[Tensor]]:
    """Values and gradients, brought to the CPU."""
    with versions(choice):
        inputs = case.on(device)
        values = case.outputs(inputs)
        gradients = case.gradients(inputs, values, random_like(values))
    return [x.detach().cpu() for x in values], [x.cpu() for x in gradients]


def few(number: float) -> str:
    """Two figures and a power of ten."""
    if not math.isfinite(number):
        return str(number)
    figures, power = f"{number:.1e}".split("e")
    return f"{figures}e{int(power)}"


def compared(case: Case, device: torch.device) -> tuple[dict[str, Any], str]:
    """A kernel on a device beside the reference on the CPU, and what is not equal, in words; "" where all is.

    Raises:
        RuntimeError, TypeError: where the device cannot do it.
    """
    (values, gradients), (wanted, wanted_gradients) = outcome(case, device, "auto"), outcome(case, CPU, "reference")
    value, other = KINDS[case.kind](values, wanted)
    gradient, _ = dense(gradients, wanted_gradients)
    found = []
    if not value <= APART:
        found.append(f"value, {few(value)} apart")
    if not other <= OTHERS:
        found.append(f"value, {100 * other:.3g}% of entries are others")
    if not gradient <= APART:
        found.append(f"gradient, {few(gradient)} apart")
    row = {"value_apart": value, "entries_other": other, "gradient_apart": gradient if case.learns else None}
    return row, "; ".join(found)


def measure(device: torch.device) -> tuple[Rows, list[str]]:
    """The table, a line a kernel, and the kernels that are not equal, with what is not."""
    rows: Rows = []
    unequal = []
    everything = cases()
    for number, (name, case) in enumerate(everything.items(), 1):
        row: dict[str, Any] = {"kernel": name}
        try:
            figures, found = compared(case, device)
            ours, plain = (case_milliseconds(case, device, x, case.learns > 0) for x in ("auto", "reference"))
            row |= {**figures, "device_ms": ours, "reference_ms": plain, "times_faster": plain / ours}
        except FAILURES as error:
            found = told(error)
        rows.append({**row, "equal": not found})
        if found:
            unequal.append(f"{name} ({found})")
        print(f"kernels {number}/{len(everything)}: {name}: {found or 'equal'}", flush=True)
    return rows, unequal
