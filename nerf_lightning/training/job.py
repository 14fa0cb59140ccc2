"""Sweep job: skipped if it is done, resumed if it was stopped, and recorded if it fails."""

import sys
import traceback
from contextlib import suppress
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from nerf_lightning.config.options import check_run_options
from nerf_lightning.errors import DiskFullError, InputError
from nerf_lightning.runs import run_lock
from nerf_lightning.runs.checkpoint import RESUME_KEYS, read_checkpoint
from nerf_lightning.runs.folder import config_to_dict, save_config
from nerf_lightning.runs.summaries import FINISHED, RunSummary, find_runs, read_run
from nerf_lightning.training.sweep import ERROR_FILE, write_table
from nerf_lightning.training.train import train
from nerf_lightning.utils.files import is_disk_full, remove_path, write_json, write_text
from nerf_lightning.utils.signals import handle_signals


def run_job(cfg: DictConfig) -> float | None:
    """Trains one job of a sweep in Hydra's folder.

    Returns:
        The held-out PSNR in dB; None for a job that failed.

    Raises:
        DiskFullError, OSError: for a full disk, which would fail the other jobs too.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    root = Path(HydraConfig.get().sweep.dir)
    try:
        with handle_signals(), run_lock.lock_folder(folder):  # may run in a launcher's process
            try:
                return continue_job(cfg, folder)
            except Exception as error:  # noqa: BLE001  (recorded with its traceback; the other jobs must go on)
                if run_lock.is_rank_zero():
                    record_error(folder, cfg, error)
                if is_disk_full(error):  # later jobs would fail too
                    raise
                return None
    except run_lock.RunFolderInUse as error:  # as by the same command, run twice at a time
        print(f"{folder.name}: {error}", file=sys.stderr, flush=True)
        return None
    finally:
        with suppress(InputError):  # interrupted before any job wrote, or a full disk, reported already
            if run_lock.is_rank_zero():
                write_table(root, find_runs(root))


def continue_job(cfg: DictConfig, folder: Path) -> float | None:
    """Skips, resumes or starts a job in a folder that this process has locked. Returns the held-out PSNR in dB."""
    check_run_options(cfg, HydraConfig.get().runtime.choices)
    previous = read_run(folder)
    has_other_run = run_lock.has_run_outputs(folder) and previous.config != config_to_dict(cfg)
    if has_other_run and previous.status != "failed" and not cfg.overwrite:
        raise run_lock.make_run_exists_error(folder)
    finished, checkpoint = find_progress(previous, cfg)
    if run_lock.is_rank_zero():
        for name in (ERROR_FILE,) if finished is not None else (ERROR_FILE, "results.json"):
            remove_path(folder / name)
    if finished is not None:
        print(f"{folder.name}: done before ({finished.status}, {finished.psnr_text})", flush=True)
        return finished.psnr
    print(f"{folder.name}: {'starts' if checkpoint is None else 'continues from its last checkpoint'}", flush=True)
    return train(cfg, checkpoint)


def find_progress(run: RunSummary, cfg: DictConfig) -> tuple[RunSummary | None, Path | None]:
    """Finds whether a run with this configuration is finished, and what it can continue from.

    Returns:
        The run, if it is finished; otherwise its last checkpoint, if there is one to continue from.
    """
    if run.config != config_to_dict(cfg):
        return None, None
    if run.status in FINISHED:
        return run, None
    last = run.folder / "checkpoints" / "last.ckpt"
    try:
        read_checkpoint(last, RESUME_KEYS)
    except InputError:  # none yet, or a damaged one: start anew
        return None, None
    return None, last


def record_error(folder: Path, cfg: DictConfig, error: Exception) -> None:
    """Writes an error to results.json, unless the run wrote one itself or an earlier run's must stay, and its traceback to
    error.txt; on a full disk as much as fits."""
    diagnosis = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    diagnosis = " ".join(diagnosis.split())
    print(f"{folder.name}: failed: {diagnosis}", file=sys.stderr, flush=True)
    with suppress(DiskFullError):
        if not (folder / "config.yaml").exists():
            with suppress(OmegaConfBaseException):  # the configuration itself may be what failed
                save_config(cfg, folder)
        if not isinstance(error, run_lock.RunFolderInUse) and read_run(folder).status != "failed":
            results = {"method": cfg.get("method"), "seed": cfg.get("seed"), "status": "failed", "diagnosis": diagnosis}
            write_json(folder / "results.json", results | {"psnr": None, "curve": [], "warnings": [], "recoveries": []})
        write_text(folder / ERROR_FILE, "".join(traceback.format_exception(error)))
