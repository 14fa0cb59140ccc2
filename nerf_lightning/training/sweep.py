"""Sweep report: a table of all jobs, their comparison, and the exit code. Imports nothing heavy."""

import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from nerf_lightning.config import resolvers  # noqa: F401  (a job's process needs them)
from nerf_lightning.runs.summaries import FINISHED, RunSummary, find_runs, find_varying_options
from nerf_lightning.utils.files import atomic_write

TABLE_FILE = "sweep.csv"
METRIC_COLUMNS = ("psnr", "ssim", "train_seconds", "steps", "parameters", "artifact_bytes")
ERROR_FILE = "error.txt"
"""In the folder of a job that failed, or was refused because of another run's results."""


def write_table(root: Path, runs: Sequence[RunSummary]) -> None:
    """Writes sweep.csv, one row per job."""
    with atomic_write(root / TABLE_FILE) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        options = find_varying_options(runs)
        writer.writerow(["job", "status", *options, *METRIC_COLUMNS, "diagnosis"])
        for run in runs:
            figures = [run.results.get(column) for column in METRIC_COLUMNS]
            values = [run.get_option(key) for key in options]
            writer.writerow([run.folder.relative_to(root), run.status, *values, *figures, run.diagnosis])


class SweepReport(Callback):
    """Hydra callback: prints the sweep's folder, then compares the jobs, and exits with code 1 unless all are done."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        # Names come from this process's command line: resolved here, they are cached for jobs in other processes.
        print(f"sweep: {config.hydra.sweep.dir}, one folder a job, such as {config.hydra.sweep.subdir}", flush=True)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        from nerf_lightning.comparison.points import PUBLISHED_FILE, read_references
        from nerf_lightning.comparison.report import write_comparison

        root = Path(config.hydra.sweep.dir)
        runs, done = find_runs(root), (*FINISHED, "stopped_early")
        unfinished = [run for run in runs if run.status not in done or (run.folder / ERROR_FILE).exists()]
        try:
            write_comparison(runs, root, read_references(PUBLISHED_FILE))
            print(f"{root / TABLE_FILE}: one row per job")
        finally:
            if unfinished:
                names = ", ".join(f"{run.folder.relative_to(root)} ({run.status})" for run in unfinished)
                line = f"{len(unfinished)} of {len(runs)} jobs are not done: {names}; the same command continues"
                print(f"nerf_lightning: {line}", file=sys.stderr)
                sys.exit(1)
