"""Where curves go besides TensorBoard and CSV files: services whose packages are extras."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lightning.pytorch.loggers import MLFlowLogger, WandbLogger

from nerf_lightning.utils.libraries import require


def wandb(
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
    require("wandb", "wandb", purpose="logging to Weights & Biases", otherwise=", or logger=csv")
    return WandbLogger(name, save_dir, project=project, offline=offline)


def mlflow(save_dir: Path, experiment_name: str = "nerf_lightning", run_name: str | None = None) -> MLFlowLogger:
    """MLflow: the server that MLFLOW_TRACKING_URI names, else `mlflow.db` in the current folder, where `mlflow ui` looks.

    Args:
        save_dir: the run's folder, where nothing is written.
        experiment_name, run_name: of the run there.

    Raises:
        InputError: where the extra `mlflow` is not installed.
    """
    require("mlflow", "mlflow", purpose="logging to MLflow", otherwise=", or logger=csv")
    uri = os.environ.get("MLFLOW_TRACKING_URI") or "sqlite:///mlflow.db"
    return MLFlowLogger(experiment_name, run_name, tracking_uri=uri)


@contextmanager
def finishing_wandb() -> Iterator[None]:
    """Ends the run that a training opens at Weights & Biases: the next one of this process would go on writing into it."""
    before = getattr(sys.modules.get("wandb"), "run", None)
    try:
        yield
    finally:
        run = getattr(sys.modules.get("wandb"), "run", None)
        if run is not None and run is not before:
            run.finish()
