"""Sweeps as a whole: a table of all jobs, and what became of them. Imports nothing heavy."""

import csv
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from nerf_lightning.config import resolvers  # noqa: F401  (a job's process needs them)
from nerf_lightning.runs.index import FINISHED, Run, find_runs, varied
from nerf_lightning.utils.files import atomic

TABLE = "sweep.csv"
COLUMNS = ("psnr", "ssim", "train_seconds", "steps", "parameters", "artifact_bytes")
ERROR = "error.txt"
"""In the folder of a job that failed, or was refused as another run's results are there."""


def write_table(root: Path, runs: Sequence[Run]) -> None:
    """Writes sweep.csv, a line for each job."""
    with atomic(root / TABLE) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        options = varied(runs)
        writer.writerow(["job", "status", *options, *COLUMNS, "diagnosis"])
        for run in runs:
            figures = [run.results.get(column) for column in COLUMNS]
            values = [run.option(key) for key in options]
            writer.writerow([run.folder.relative_to(root), run.status, *values, *figures, run.diagnosis])


class SweepReport(Callback):
    """Hydra's hooks around the jobs: their folder, then their comparison, and exit code 1 unless all are done."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        # Names come from this process's command line: resolved here, they are cached for jobs in other processes.
        print(f"sweep: {config.hydra.sweep.dir}, one folder a job, such as {config.hydra.sweep.subdir}", flush=True)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        from nerf_lightning.comparison.points import PUBLISHED, read_references
        from nerf_lightning.comparison.report import write_comparison

        root = Path(config.hydra.sweep.dir)
        runs = find_runs(root)
        left = [run for run in runs if run.status not in (*FINISHED, "stopped_early") or (run.folder / ERROR).exists()]
        try:
            write_comparison(runs, root, read_references(PUBLISHED))
            print(f"{root / TABLE}: a line for each job")
        finally:
            if left:
                names = ", ".join(f"{run.folder.relative_to(root)} ({run.status})" for run in left)
                line = f"{len(left)} of {len(runs)} jobs are not done: {names}; the same command continues"
                print(f"nerf_lightning: {line}", file=sys.stderr)
                sys.exit(1)
