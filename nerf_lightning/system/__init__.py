"""Stage 6, systems: LightningModules that hold step, loss, metrics and optimiser, and nothing else."""

from nerf_lightning.system.metrics import mse_to_psnr, psnr, ssim
from nerf_lightning.system.nerf2d import NeRF2D
from nerf_lightning.system.nerf3d import NeRF3D
from nerf_lightning.system.photos import RENDERED_PIXELS, aligned_psnr, misfits, psnr_of_photos
from nerf_lightning.system.schedule import constant, cosine, exponential
from nerf_lightning.system.state import TrainingClock, TrainingState
from nerf_lightning.system.system import StepStats, System, ViewResult

__all__ = [
    "RENDERED_PIXELS",
    "NeRF2D",
    "NeRF3D",
    "StepStats",
    "System",
    "TrainingClock",
    "TrainingState",
    "ViewResult",
    "aligned_psnr",
    "constant",
    "cosine",
    "exponential",
    "misfits",
    "mse_to_psnr",
    "psnr",
    "psnr_of_photos",
    "ssim",
]
