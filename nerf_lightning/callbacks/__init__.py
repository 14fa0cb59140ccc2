"""Lightning callbacks: budget, validation, images, checkpoints, progress, results."""

from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.checkpoints import Checkpoints
from nerf_lightning.callbacks.divergence_recovery import DivergenceRecovery
from nerf_lightning.callbacks.evaluation import Evaluation
from nerf_lightning.callbacks.live_viewer import LiveViewer
from nerf_lightning.callbacks.orbit import Orbit
from nerf_lightning.callbacks.picture_report import PictureReport, PictureUpscaling
from nerf_lightning.callbacks.progress import ProgressBar
from nerf_lightning.callbacks.snapshots import Snapshots
from nerf_lightning.callbacks.throughput import Throughput
from nerf_lightning.callbacks.validation import PeriodicValidation

__all__ = [
    "Budget",
    "Checkpoints",
    "DivergenceRecovery",
    "Evaluation",
    "LiveViewer",
    "Orbit",
    "PeriodicValidation",
    "PictureReport",
    "PictureUpscaling",
    "ProgressBar",
    "Snapshots",
    "Throughput",
]
