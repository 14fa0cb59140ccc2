"""Throughput: logs losses, learning rates and training speed."""

from typing import Any

import lightning as L

from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.system import System, mse_to_psnr
from nerf_lightning.utils.option_checks import Count

TRAIN_SECONDS_KEY = "speed/train_seconds"
"""Training seconds of a step's metrics, logged with them."""


class Throughput(L.Callback):
    """Logs loss terms, batch PSNR, learning rates, rays per second and samples per ray, every `every` steps.

    Lightning's `ThroughputMonitor` supports neither a clock that pauses nor rays.

    Args:
        every: steps between log entries, over which the speeds are averaged.
    """

    def __init__(self, every: Count = 20):
        self.every = every
        self.rays = 0
        """Rays (or pixels) trained on since the run began, over all resumes."""
        self._last_entry = (0.0, 0)  # seconds and rays at the last entry
        self._samples = 0

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self._last_entry = (Budget.find(trainer).seconds, self.rays)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        stats, step = pl_module.stats, trainer.global_step
        self.rays += stats.rays * trainer.world_size
        self._samples += stats.samples * trainer.world_size
        if step % self.every:
            return
        seconds, rays = Budget.find(trainer).seconds, self.rays - self._last_entry[1]
        if trainer.logger is not None:
            scalars = {
                **{f"loss/{name}": float(term) for name, term in stats.losses.items()},
                "train/psnr": mse_to_psnr(float(stats.mse)),
                **{f"lr/{group['name']}": float(group["lr"]) for group in trainer.optimizers[0].param_groups},
                "speed/rays_per_second": rays / max(seconds - self._last_entry[0], 1e-9),
                "speed/samples_per_ray": self._samples / max(rays, 1),
                TRAIN_SECONDS_KEY: seconds,
            }
            trainer.logger.log_metrics(scalars, step)
        self._last_entry, self._samples = (seconds, self.rays), 0

    def state_dict(self) -> dict[str, int]:
        return {"rays": self.rays}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        self.rays = state_dict["rays"]
