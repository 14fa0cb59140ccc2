"""Field growth during training: coarse grids find the shape sooner, fine ones hold the detail."""

from typing import TYPE_CHECKING

import lightning as L
import torch
from lightning.pytorch.strategies import DDPStrategy

from nerf_lightning.dataset import RayBatch, RayDataModule

if TYPE_CHECKING:
    from nerf_lightning.system.nerf3d import NeRF3D


def compute_next_stage(system: "NeRF3D", step: int) -> int | None:
    """Growth stage due at this step; None if the field keeps its stage.

    Follows progress, clamped for few or many steps (see `ResolutionSchedule.clamp_progress`) and delayed by pose refinement.
    """
    growth, progress, corrections = system.field.growth, system.state.progress, system.corrections
    if growth is None:
        return None
    if corrections is not None:
        progress = corrections.delay_growth(progress, growth.end)
    stage = growth.stage_at(growth.clamp_progress(progress, step, allow_shortening=corrections is None))
    return stage if stage > system.field.stage else None


def sync_resolution_scale(system: "NeRF3D", data: RayDataModule) -> None:
    """Passes the field's resolution scale on to the sampler's step size and the data's samples per step."""
    system.sampler.set_resolution_scale(system.field.resolution_scale)
    data.set_resolution_scale(system.field.resolution_scale)


@torch.no_grad()
def upsample_field(system: "NeRF3D", data: RayDataModule, stage: int, optimizer: torch.optim.Optimizer) -> None:
    """Upsamples the field and drops the optimizer state of resized parameters."""
    for parameter in system.field.upsample(stage):
        optimizer.state.pop(parameter, None)
    sync_resolution_scale(system, data)


class FieldGrowth(L.Callback):
    """Upsamples the field when its next stage is due."""

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: "NeRF3D", batch: RayBatch, batch_idx: int) -> None:
        stage = compute_next_stage(pl_module, trainer.global_step)
        if stage is None:
            return
        if trainer.world_size > 1:  # each process saw different rays, but all must grow alike
            for buffer in pl_module.buffers():
                torch.distributed.broadcast(buffer, 0)
        upsample_field(pl_module, pl_module.datamodule, stage, trainer.optimizers[0])
        if isinstance(trainer.strategy, DDPStrategy):  # its gradient buckets have the old size
            trainer.strategy.model = pl_module
            trainer.strategy.configure_ddp()
