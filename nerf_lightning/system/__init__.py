"""LightningModules: training step, losses, metrics and optimizer of NeRF2D and NeRF3D."""

from nerf_lightning.system.metrics import mse_to_psnr, psnr, ssim
from nerf_lightning.system.nerf2d import NeRF2D
from nerf_lightning.system.nerf3d import NeRF3D
from nerf_lightning.system.photo_quality import (
    ALIGN_COST_PIXELS,
    find_outlier_photos,
    measure_aligned_psnr,
    measure_photo_psnr,
)
from nerf_lightning.system.schedule import constant, cosine, exponential
from nerf_lightning.system.state import TrainingClock, TrainingState
from nerf_lightning.system.system import StepStats, System, ViewResult

__all__ = [
    "ALIGN_COST_PIXELS",
    "NeRF2D",
    "NeRF3D",
    "StepStats",
    "System",
    "TrainingClock",
    "TrainingState",
    "ViewResult",
    "constant",
    "cosine",
    "exponential",
    "find_outlier_photos",
    "measure_aligned_psnr",
    "measure_photo_psnr",
    "mse_to_psnr",
    "psnr",
    "ssim",
]
