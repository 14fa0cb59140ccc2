"""Where curves go: TensorBoard, and services whose packages are extras."""

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

LOGGED_OPTIONS = (
    "dataset",
    "model",
    "sampler",
    "renderer",
    "optimizer",
    "schedule",
    "budget",
    "method",
    "recipe",
    "seed",
)
"""What services are told of the configuration."""
LOGGED_METRICS = ("psnr", "ssim", "psnr_worst_view", "train_seconds", "render_seconds_per_view", "artifact_bytes")
"""And of the results."""


class TimedTensorBoardLogger(TensorBoardLogger):
    """TensorBoard with one event file a run, and times that are seconds of training.

    Figures logged with `TRAIN_SECONDS_KEY` are dated by it: on TensorBoard's axis RELATIVE they run over training time.

    Args:
        save_dir: the run's folder, which holds the file.
    """

    def __init__(self, save_dir: str | Path):
        super().__init__(save_dir, name="", version="", default_hp_metric=False)

    @functools.cached_property
    def began(self) -> float:
        return time.time()

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        seconds = metrics.get(TRAIN_SECONDS_KEY)
        date = None if seconds is None else self.began + seconds
        for name, value in metrics.items():
            self.experiment.add_scalar(name, value, step, walltime=date)

    @rank_zero_only
    def log_summary(self, options: Mapping[str, Any], results: Mapping[str, Any]) -> None:
        """Fills the HParams tab and closes the file. PSNR and seconds are curves, whose last values the tab shows."""
        from torch.utils.tensorboard.summary import hparams

        values = {key: options.get(key) or "" for key in ("method", "recipe")}
        values |= {"seed": options["seed"], "bytes": results["artifact_bytes"]}
        for summary in hparams(values, dict.fromkeys(("val/psnr", TRAIN_SECONDS_KEY), 0.0)):
            self.experiment.file_writer.add_summary(summary)
        self.experiment.close()

    def save(self) -> None:
        """Writes no hparams.yaml: a run's config.yaml has all."""

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """Closes the file of a run that failed; testing goes on writing after training."""
        if status != "success":
            self.experiment.close()


def log_summary(logger: Logger, options: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    """Writes a run's options and final figures, and closes the logger."""
    if isinstance(logger, TimedTensorBoardLogger):
        logger.log_summary(options, results)
        return
    logger.log_hyperparams({key: options[key] for key in LOGGED_OPTIONS if options.get(key) is not None})
    logger.log_metrics(
        {f"final/{key}": results[key] for key in LOGGED_METRICS if results[key] is not None}, results["steps"]
    )
    logger.finalize("success")


def make_wandb_logger(
    save_dir: Path, project: str = "nerf_lightning", name: str | None = None, offline: bool = False
) -> WandbLogger:
    """Weights & Biases.

    Args:
        save_dir: of its own files, below `wandb/`.
        project, name: of the run there.
        offline: whether to keep the run in those files, for `wandb sync`.

    Raises:
        InputError: where the extra `wandb` is not installed.
    """
    require_extra("wandb", "wandb", purpose="logging to Weights & Biases", hint=", or logger=csv")
    return WandbLogger(name, save_dir, project=project, offline=offline)


def make_mlflow_logger(
    save_dir: Path, experiment_name: str = "nerf_lightning", run_name: str | None = None
) -> MLFlowLogger:
    """MLflow: the server that MLFLOW_TRACKING_URI names, else `mlflow.db` in the current folder, where `mlflow ui` looks.

    Args:
        save_dir: the run's folder, where nothing is written.
        experiment_name, run_name: of the run there.

    Raises:
        InputError: where the extra `mlflow` is not installed.
    """
    require_extra("mlflow", "mlflow", purpose="logging to MLflow", hint=", or logger=csv")
    uri = os.environ.get("MLFLOW_TRACKING_URI") or "sqlite:///mlflow.db"
    return MLFlowLogger(experiment_name, run_name, tracking_uri=uri)


@contextmanager
def finish_wandb() -> Iterator[None]:
    """Ends the run that a training opens at Weights & Biases: the next one of this process would go on writing into it."""
    before = getattr(sys.modules.get("wandb"), "run", None)
    try:
        yield
    finally:
        run = getattr(sys.modules.get("wandb"), "run", None)
        if run is not None and run is not before:
            run.finish()
