"""Sweeps: each job runs once, a failing one does not stop the others, and a table lists them all."""

import csv
import shutil
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf.errors import OmegaConfBaseException

from nerf_lightning.config import cli  # noqa: F401  (a job's process needs its resolvers)
from nerf_lightning.errors import InputError
from nerf_lightning.runs.index import FINISHED, Run, failed_results, find_runs, read_run, varied
from nerf_lightning.utils.files import atomic, write_json

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from nerf_lightning.training.sweep_plan import SweepProgress

TABLE = "sweep.csv"
COLUMNS = ("psnr", "ssim", "train_seconds", "steps", "parameters", "artifact_bytes")
OUTCOME = ("results.json", "error.txt")
"""Files that say how a job ended; removed when it starts again."""
STATE = ("final.png", "checkpoints", "snapshots")
"""Files of an earlier run with other options, which could be mistaken for the new one's."""


def job(cfg: "DictConfig") -> float | None:
    """One job of a sweep: skipped if it is done, resumed if it was stopped. Never raises.

    Returns:
        The held-out PSNR in dB; None for a job that failed.
    """
    from lightning.pytorch.utilities.rank_zero import rank_zero_only

    folder = Path(HydraConfig.get().runtime.output_dir)
    root = Path(HydraConfig.get().sweep.dir)
    leader = getattr(rank_zero_only, "rank", 0) == 0  # if several processes share a job, only the first writes
    try:
        from nerf_lightning.runs.folder import plain_config
        from nerf_lightning.training.train import train

        before = read_run(folder)
        same = before.config == plain_config(cfg)
        if same and before.status in FINISHED:
            told = "without a figure" if before.psnr is None else f"{before.psnr:.2f} dB"
            print(f"{folder.name}: done before ({before.status}, {told})", flush=True)
            return before.psnr
        last = folder / "checkpoints" / "last.ckpt"
        checkpoint = last if same and usable(last) else None
        if leader:
            for name in OUTCOME if checkpoint else OUTCOME + STATE:
                remove(folder / name)
        print(f"{folder.name}: {'starts' if checkpoint is None else 'goes on from its last checkpoint'}", flush=True)
        return train(cfg, checkpoint)
    except Exception as error:  # noqa: BLE001  (recorded with its traceback; the other jobs must go on)
        if leader:
            record(folder, cfg, error)
        return None
    finally:
        with suppress(InputError):  # interrupted before any job wrote something
            if leader:
                write_table(root, find_runs(root))


def usable(checkpoint: Path) -> bool:
    """Whether a checkpoint exists and is complete."""
    from nerf_lightning.runs.checkpoint import RESUMED, read_checkpoint

    try:
        read_checkpoint(checkpoint, RESUMED)
    except InputError:
        return False
    return True


def remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def record(folder: Path, cfg: "DictConfig", error: Exception) -> None:
    """Writes what went wrong: to results.json, unless the run wrote one itself, and with its traceback to error.txt."""
    from nerf_lightning.runs.folder import save_config

    diagnosis = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    diagnosis = " ".join(diagnosis.split())
    print(f"{folder.name}: failed: {diagnosis}", file=sys.stderr, flush=True)
    if not (folder / "config.yaml").exists():
        with suppress(OmegaConfBaseException):  # the configuration itself may be what failed
            save_config(cfg, folder)
    with atomic(folder / "error.txt") as temporary:
        temporary.write_text("".join(traceback.format_exception(error)), encoding="utf-8")
    if read_run(folder).status != "failed":
        write_json(folder / "results.json", failed_results(cfg.get("method"), cfg.get("seed"), diagnosis))


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


def print_table(root: Path, runs: Sequence[Run]) -> None:
    """Prints the same table, best first."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=str(root))
    for heading in ("job", "status", "dB", "seconds", "steps", "parameters"):
        table.add_column(heading, overflow="fold", justify="left" if heading in ("job", "status") else "right")

    def cell(value: Any, digits: int = 0) -> str:
        return f"{value:,.{digits}f}" if isinstance(value, int | float) else "-"

    for run in sorted(runs, key=lambda run: float("-inf") if run.psnr is None else run.psnr, reverse=True):
        name = str(run.folder.relative_to(root))
        seconds, steps, parameters = (run.results.get(key) for key in ("train_seconds", "steps", "parameters"))
        figures = [cell(run.psnr, 2), cell(seconds, 1), cell(steps), cell(parameters)]
        table.add_row(name, run.status, *figures)
    console = Console()
    console.print(table)
    for run in runs:
        if run.diagnosis:
            console.print(f"{run.folder.relative_to(root)}: {run.diagnosis}", style="dim", markup=False, soft_wrap=True)


class SweepReport(Callback):
    """Hydra's hooks around the jobs: progress, then table, figure, and exit code 1 if a job failed."""

    def __init__(self) -> None:
        self.progress: SweepProgress | None = None

    def on_multirun_start(self, config: "DictConfig", **kwargs: Any) -> None:
        from nerf_lightning.training.sweep_plan import SweepProgress, devices_asked, planned
        from nerf_lightning.utils.device import the_device

        try:
            for name in devices_asked(config):
                the_device(name)
        except InputError as error:  # Hydra would only warn
            cli.give_up(error)
        # Names come from this process's command line: resolved here, they are cached for jobs in other processes.
        print(f"sweep: {config.hydra.sweep.dir}, one folder a job, such as {config.hydra.sweep.subdir}", flush=True)
        jobs = planned(config)
        self.progress = SweepProgress(Path(config.hydra.sweep.dir), jobs) if jobs else None

    def on_job_start(self, config: "DictConfig", **kwargs: Any) -> None:
        if self.progress is not None:
            print(self.progress.begin(config.hydra.job.num), flush=True)

    def on_job_end(self, config: "DictConfig", **kwargs: Any) -> None:
        if self.progress is not None:
            self.progress.end(config.hydra.job.num)

    def on_multirun_end(self, config: "DictConfig", **kwargs: Any) -> None:
        from nerf_lightning.gallery.figure import write_contact_figure

        root = Path(config.hydra.sweep.dir)
        runs = find_runs(root)
        write_table(root, runs)
        print_table(root, runs)
        failed = [run for run in runs if run.status not in FINISHED and run.status != "stopped_early"]
        try:
            print(f"table: {root / TABLE}; figure: {write_contact_figure(root, runs)}")
            print(f"speed against accuracy: python -m nerf_lightning.chart runs={root}")
        finally:
            if failed:
                told = ", ".join(str(run.folder.relative_to(root)) for run in failed)
                print(f"nerf_lightning: {len(failed)} of {len(runs)} jobs failed: {told}", file=sys.stderr)
                sys.exit(1)
