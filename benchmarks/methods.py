"""Method comparison: PSNR over training time, each run in a separate process, as a user would train it."""

import argparse
import itertools
import json
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.tables import Row, Rows

METHODS = ("tensorf", "hashgrid", "voxels", "mlp")
"""3D methods; NAME_medium is the recipe of each in its default size."""
TARGETS_DB = (24, 27, 30)
REPORT_SECONDS = (10, 30, 60, 300)
CHECK_SECONDS = (0.5, 1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 120, 150, 180, 240)
"""Seconds of training at which a run is validated, up to its budget."""

Run = dict[str, Any]


def format_fractions(seconds: float) -> str:
    """Fractions of a budget at which a run is validated, comma-separated."""
    return ",".join(str(check / seconds) for check in CHECK_SECONDS if check < seconds)


def train(experiment: str, overrides: list[str], seed: int, folder: Path, validation_fractions: str = "") -> Run:
    """Trains in a subprocess; returns the content of results.json."""
    command = [sys.executable, "-m", "nerf_lightning", f"+experiment={experiment}", *overrides]
    command += [f"seed={seed}", f"callbacks.validation.fractions=[{validation_fractions}]"]
    command += ["callbacks.snapshots.steps=[]", "callbacks.orbit=null", f"hydra.run.dir='{folder}'"]
    completed = subprocess.run(command, capture_output=True, text=True, check=False)
    if completed.returncode:
        raise SystemExit(f"benchmarks: {experiment} failed: {completed.stderr.strip().splitlines()[-1:]}")
    return json.loads((folder / "results.json").read_text(encoding="utf-8"))


def find_seconds_to_psnr(curve: list[list[float]], target: float) -> float | None:
    """Training seconds at which the curve [[seconds, step, dB], ...] first reaches the target."""
    return next((seconds for seconds, _, quality in curve if quality >= target), None)


def censored_median(values: list[float | None]) -> float | None:
    """Median with missing values as infinity; None if the median is missing."""
    middle = median(float("inf") if value is None else value for value in values)
    return None if middle == float("inf") else middle


def summarize(method: str, by_budget: dict[float, list[Run]]) -> Row:
    """Summarizes a method's runs in one row, medians over seeds.

    Seconds to a PSNR come from the fastest budget; dB after some seconds from the shortest budget that lasts so long, since
    the learning rate anneals toward the end of the budget.
    """
    row: Row = {"method": method, "seeds": min(len(runs) for runs in by_budget.values())}
    for target in TARGETS_DB:
        seconds = [[find_seconds_to_psnr(run["curve"], target) for run in runs] for runs in by_budget.values()]
        times = map(censored_median, seconds)
        row[f"seconds_to_{target}_db"] = min((t for t in times if t is not None), default=None)
    for moment in REPORT_SECONDS:
        budget = min((seconds for seconds in by_budget if seconds >= moment), default=None)
        if budget is not None:
            curves = [[point for point in run["curve"] if point[0] <= moment + 1] for run in by_budget[budget]]
            row[f"db_at_{moment}_s"] = median(max(curve, key=lambda point: point[0])[2] for curve in curves)
    runs = by_budget[max(by_budget)]
    row["steps_per_second"] = median(run["steps"] / run["train_seconds"] for run in runs)
    row["rays_per_second"] = median(run["rays_per_second"] for run in runs)
    row["render_seconds_per_view"] = median(run["render_seconds_per_view"] for run in runs)
    row["peak_memory_bytes"] = median(run["peak_memory_bytes"] for run in runs)
    row["parameter_bytes"] = median(4 * run["parameters"] for run in runs)
    row["psnr_worst_seed"] = min(run["psnr"] for run in runs)
    return row


def measure(args: argparse.Namespace) -> Rows:
    """Trains each experiment with every budget and seed; one row per experiment."""
    rows: Rows = []
    for experiment in args.experiments:
        by_budget: dict[float, list[Run]] = {}
        for seconds, seed in itertools.product(args.budgets, args.seeds):
            options = [*args.overrides, f"device={args.device.type}", f"budget.seconds={seconds}"]
            folder = args.output / f"{experiment}_{seconds:g}s_seed{seed}"
            try:
                run = train(experiment, options, seed, folder, format_fractions(seconds))
            except SystemExit as failure:
                rows.append({"method": experiment, "differs": str(failure)})
                break
            print(f"methods: {experiment}, {seconds:g} s, seed {seed}: {run['psnr']:.2f} dB", flush=True)
            by_budget.setdefault(seconds, []).append(run)
        else:
            rows.append(summarize(experiment, by_budget))
    return rows
