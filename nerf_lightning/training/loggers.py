"""Loggers: TensorBoard over training time, Weights & Biases, and MLflow."""

import functools
import os
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from nerf_lightning.callbacks.throughput import TRAIN_SECONDS_KEY
from nerf_lightning.utils.libraries import require_extra

LOGGED_GROUPS = ("dataset", "model", "sampler", "renderer", "optimizer", "schedule", "budget")
LOGGED_OPTIONS = (*LOGGED_GROUPS, "method", "recipe", "seed")
"""Configuration keys logged as hyperparameters."""
LOGGED_METRICS = ("psnr", "ssim", "psnr_worst_view", "train_seconds", "render_seconds_per_view", "artifact_bytes")
"""Results logged as final metrics."""


class TimedTensorBoardLogger(TensorBoardLogger):
    """TensorBoard logger with one event file per run, and training seconds as its times.

    Metrics logged with `TRAIN_SECONDS_KEY` are dated by it: TensorBoard's axis RELATIVE shows training time.

    Args:
        save_dir: the run's folder, which holds the file.
    """

    def __init__(self, save_dir: str | Path):
        super().__init__(save_dir, name="", version="", default_hp_metric=False)

    @functools.cached_property
    def start_time(self) -> float:
        return time.time()

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        seconds = metrics.get(TRAIN_SECONDS_KEY)
        walltime = None if seconds is None else self.start_time + seconds
        for name, value in metrics.items():
            self.experiment.add_scalar(name, value, step, walltime=walltime)

    @rank_zero_only
    def log_summary(self, options: Mapping[str, Any], results: Mapping[str, Any]) -> None:
        """Fills the HParams tab and closes the file. The tab shows the last values of the PSNR and seconds curves."""
        from torch.utils.tensorboard.summary import hparams

        values = {key: options.get(key) or "" for key in ("method", "recipe")}
        values |= {"seed": options["seed"], "bytes": results["artifact_bytes"]}
        for summary in hparams(values, dict.fromkeys(("val/psnr", TRAIN_SECONDS_KEY), 0.0)):
            self.experiment.file_writer.add_summary(summary)
        self.experiment.close()

    def save(self) -> None:
        """Writes no hparams.yaml: the run's config.yaml holds everything."""

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Closes the file of a failed run; after training, testing continues it."""
        if status != "success":
            self.experiment.close()


def log_summary(logger: Logger, options: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    """Logs a run's options and final metrics, and closes the logger."""
    if isinstance(logger, TimedTensorBoardLogger):
        logger.log_summary(options, results)
        return
    logger.log_hyperparams({key: options[key] for key in LOGGED_OPTIONS if options.get(key) is not None})
    metrics = {f"final/{key}": results[key] for key in LOGGED_METRICS if results[key] is not None}
    logger.log_metrics(metrics, results["steps"])
    logger.finalize("success")


def make_wandb_logger(
    save_dir: Path, project: str = "nerf_lightning", name: str | None = None, offline: bool = False
) -> WandbLogger:
    """Makes a Weights & Biases logger.

    Args:
        save_dir: of its files, below `wandb/`.
        project, name: of the W&B run.
        offline: whether to keep the run in those files, for `wandb sync`.

    Raises:
        InputError: if the extra `wandb` is not installed.
    """
    require_extra("wandb", "wandb", purpose="logging to Weights & Biases", hint=", or logger=csv")
    return WandbLogger(name, save_dir, project=project, offline=offline)


def make_mlflow_logger(
    save_dir: Path, experiment_name: str = "nerf_lightning", run_name: str | None = None
) -> MLFlowLogger:
    """Makes an MLflow logger, for the server in MLFLOW_TRACKING_URI, else for `mlflow.db` in the current folder.

    Args:
        save_dir: the run's folder, where nothing is written.
        experiment_name, run_name: of the MLflow run.

    Raises:
        InputError: if the extra `mlflow` is not installed.
    """
    require_extra("mlflow", "mlflow", purpose="logging to MLflow", hint=", or logger=csv")
    uri = os.environ.get("MLFLOW_TRACKING_URI") or "sqlite:///mlflow.db"
    return MLFlowLogger(experiment_name, run_name, tracking_uri=uri)


@contextmanager
def finish_wandb() -> Iterator[None]:
    """Finishes the W&B run that a training opens, or the next one in this process would write into it."""
    before = getattr(sys.modules.get("wandb"), "run", None)
    try:
        yield
    finally:
        run = getattr(sys.modules.get("wandb"), "run", None)
        if run is not None and run is not before:
            run.finish()
