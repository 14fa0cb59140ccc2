"""Sweeps: each job runs once, a failing one does not stop the others, and a table lists them all."""

import csv
import math
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf.errors import OmegaConfBaseException

from nerf_lightning.config import resolvers  # noqa: F401  (a job's process needs them)
from nerf_lightning.errors import InputError, NoRoom
from nerf_lightning.runs.index import FINISHED, Run, failed_results, find_runs, read_run, varied
from nerf_lightning.utils.files import atomic, full_disk, remove, write_json
from nerf_lightning.utils.progress import clock
from nerf_lightning.utils.signals import CONTINUE, handle_signals

if TYPE_CHECKING:
    from omegaconf import DictConfig

TABLE = "sweep.csv"
COLUMNS = ("psnr", "ssim", "train_seconds", "steps", "parameters", "artifact_bytes")
ERROR = "error.txt"
"""In the folder of a job that failed, or was refused as another run's results are there."""


def job(cfg: "DictConfig") -> float | None:
    """One job of a sweep: skipped if it is done, resumed if it was stopped.

    Returns:
        The held-out PSNR in dB; None for a job that failed.

    Raises:
        NoRoom, OSError: for a full disk, which would end the other jobs too.
    """
    from nerf_lightning.runs.owner import Taken, leads, owned

    folder = Path(HydraConfig.get().runtime.output_dir)
    root = Path(HydraConfig.get().sweep.dir)
    try:
        with handle_signals(), owned(folder):  # this may be a process of a launcher
            try:
                return trained(cfg, folder)
            except Exception as error:  # noqa: BLE001  (recorded with its traceback; the other jobs must go on)
                if leads():
                    record(folder, cfg, error)
                if full_disk(error):  # and for the jobs after it
                    raise
                return None
    except Taken as error:  # as by the same command a second time: what it does is not done twice
        print(f"{folder.name}: {error}", file=sys.stderr, flush=True)
        return None
    finally:
        with suppress(InputError):  # interrupted before any job wrote something, or a full disk, which has been told
            if leads():
                write_table(root, find_runs(root))


def trained(cfg: "DictConfig", folder: Path) -> float | None:
    """The held-out PSNR of a job in a folder that this process owns, from now, from before, or from its last checkpoint on."""
    from nerf_lightning.config.options import check_run_options
    from nerf_lightning.runs.folder import plain_config
    from nerf_lightning.runs.owner import already, holds_run, leads
    from nerf_lightning.training.before import left_of
    from nerf_lightning.training.train import train

    check_run_options(cfg, HydraConfig.get().runtime.choices)
    before = read_run(folder)
    other = holds_run(folder) and before.config != plain_config(cfg)
    if other and before.status != "failed" and not cfg.overwrite:
        raise already(folder)
    done, checkpoint = left_of(before, cfg)
    if leads():
        for name in (ERROR,) if done is not None else (ERROR, "results.json"):
            remove(folder / name)
    if done is not None:
        told = "without a figure" if done.psnr is None else f"{done.psnr:.2f} dB"
        print(f"{folder.name}: done before ({done.status}, {told})", flush=True)
        return done.psnr
    print(f"{folder.name}: {'starts' if checkpoint is None else 'continues from its last checkpoint'}", flush=True)
    return train(cfg, checkpoint)


def record(folder: Path, cfg: "DictConfig", error: Exception) -> None:
    """Writes what went wrong: to results.json, unless the run wrote one itself or an earlier run's must stay, and with its
    traceback to error.txt; on a full disk as much of it as there is room for."""
    from nerf_lightning.runs.folder import save_config
    from nerf_lightning.runs.owner import Taken

    diagnosis = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    diagnosis = " ".join(diagnosis.split())
    print(f"{folder.name}: failed: {diagnosis}", file=sys.stderr, flush=True)
    with suppress(NoRoom):
        if not (folder / "config.yaml").exists():
            with suppress(OmegaConfBaseException):  # the configuration itself may be what failed
                save_config(cfg, folder)
        if not isinstance(error, Taken) and read_run(folder).status != "failed":
            write_json(folder / "results.json", failed_results(cfg.get("method"), cfg.get("seed"), diagnosis))
        with atomic(folder / ERROR) as temporary:
            temporary.write_text("".join(traceback.format_exception(error)), encoding="utf-8")


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


def count_jobs(config: "DictConfig") -> int | None:
    """Number of jobs of a sweep over a grid; None where the sweeper chooses them as it goes."""
    if not config.hydra.sweeper._target_.endswith("BasicSweeper"):
        return None
    params = [f"{key}={value}" for key, value in (config.hydra.sweeper.get("params") or {}).items()]
    parsed = OverridesParser.create().parse_overrides([*params, *config.hydra.overrides.task])
    choices = {one.key_or_group: len([*one.sweep_iterator()]) if one.is_sweep_override() else 1 for one in parsed}
    return math.prod(choices.values())


class SweepReport(Callback):
    """Hydra's hooks around the jobs: progress, then their comparison, and exit code 1 if a job failed."""

    def __init__(self) -> None:
        self.jobs: int | None = None
        self.began = 0.0

    def on_multirun_start(self, config: "DictConfig", **kwargs: Any) -> None:
        # Names come from this process's command line: resolved here, they are cached for jobs in other processes.
        print(f"sweep: {config.hydra.sweep.dir}, one folder a job, such as {config.hydra.sweep.subdir}", flush=True)
        self.jobs, self.began = count_jobs(config), time.monotonic()

    def on_job_start(self, config: "DictConfig", **kwargs: Any) -> None:
        if self.jobs is not None:
            number = config.hydra.job.num
            left = (time.monotonic() - self.began) / max(number, 1) * (self.jobs - number)
            words = f", about {clock(left)} left" if number else ""
            print(f"job {number + 1} of {self.jobs}{words}", flush=True)

    def on_multirun_end(self, config: "DictConfig", **kwargs: Any) -> None:
        from nerf_lightning.comparison.points import PUBLISHED, read_references
        from nerf_lightning.comparison.report import write_comparison

        root = Path(config.hydra.sweep.dir)
        runs = find_runs(root)
        write_table(root, runs)
        done = [run for run in runs if run.status in (*FINISHED, "stopped_early") and not (run.folder / ERROR).exists()]
        going = [run for run in runs if run.status == "unfinished"]
        stopped = [run for run in runs if run.status == "interrupted"]
        failed = [run for run in runs if run not in (*done, *going, *stopped)]
        try:
            write_comparison(runs, root, read_references(PUBLISHED))
            print(f"{root / TABLE}: a line for each job")
        finally:
            ended = ((failed, "failed"), (going, "have not ended"), (stopped, f"were interrupted ({CONTINUE})"))
            for some, what in ended:
                if some:
                    told = ", ".join(str(run.folder.relative_to(root)) for run in some)
                    print(f"nerf_lightning: {len(some)} of {len(runs)} jobs {what}: {told}", file=sys.stderr)
            if failed or going or stopped:
                sys.exit(1)
