"""Fields that grow, without a trainer."""

import torch

from nerf_lightning.model import Field


def grow(field: Field, progress: float) -> list[torch.nn.Parameter]:
    """Upsamples a field if its next stage is due after this share of the training."""
    stage = 0 if field.growth is None else field.growth.stage_at(progress)
    return field.upsample(stage) if stage > field.stage else []
