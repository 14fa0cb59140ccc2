"""What happens around the training steps: budget, measurement, pictures, checkpoints, progress, results."""

from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.checkpoints import Checkpoints
from nerf_lightning.callbacks.evaluation import Evaluation
from nerf_lightning.callbacks.guard import Guard
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.callbacks.live import Live
from nerf_lightning.callbacks.orbit import Orbit
from nerf_lightning.callbacks.pictures import Enlarge, PictureReport
from nerf_lightning.callbacks.progress import Progress
from nerf_lightning.callbacks.snapshots import Snapshots
from nerf_lightning.callbacks.throughput import Throughput

__all__ = [
    "Budget",
    "Checkpoints",
    "Enlarge",
    "Evaluation",
    "Guard",
    "HeldOut",
    "Live",
    "Orbit",
    "PictureReport",
    "Progress",
    "Snapshots",
    "Throughput",
]
