"""Small runs on the pretended device, and what is asked of them in several tests."""

from pathlib import Path

import torch

from nerf_lightning.config.build import build_data, build_system, frame_of
from nerf_lightning.config.compose import composed
from nerf_lightning.system import System
from nerf_lightning.system.growth import grow_field, next_stage
from nerf_lightning.system.system import total_loss
from nerf_lightning.utils.seeding import Stream, step_generator
from tests.helpers.train_models import MODELS

SCENES = ("hashgrid", "voxels", "tensorf", "mlp")
ON_IT = ("device=pretend", "+trainer.inference_mode=false", "~logger")
"""Its tensors know no inference mode."""
QUICK = ("model.grown=0.5", "sampler.update_every=4", "sampler.warmup=8")
SAMPLERS = {
    "uniform": ["sampler=uniform", "sampler.samples=16"],
    "stratified": ["sampler=stratified", "sampler.samples=16"],
    "importance": ["sampler=importance", "sampler.samples=8", "sampler.fine=8"],
    "proposal": ["sampler=proposal", "sampler.samples=8", "sampler.first=8", "sampler.second=8"],
}


def options(name: str) -> list[str]:
    """A model's, small, growing where it does; with an orbit of two frames."""
    given = [option for option in MODELS[name] if option not in ("callbacks.orbit=null", "model.grown=1")]
    if name not in SCENES:
        return [f"model={name}", *given]
    if name in ("mlp", "hashgrid"):
        return [f"model={name}", *given, *QUICK[1:], "callbacks.orbit.frames=2"]
    return [f"model={name}", *given, *QUICK, "callbacks.orbit.frames=2"]


def system_of(given: list[str], folder: Path) -> tuple[System, object]:
    cfg = composed(given, folder)
    data = build_data(cfg)
    return build_system(cfg, frame_of(data)), data


def stepped(system: System, data: object, steps: int, where: torch.device) -> list[float]:
    """The losses of the first steps of a scene's training, drawn alike on every device."""
    optimizer, losses = system.configure_optimizers(), []
    for step in range(steps):
        system.state.advance(step / steps)
        if (stage := next_stage(system, step)) is not None:
            grow_field(system, data, stage, optimizer)
        batch, generator = data.draw(step).to(where), step_generator(0, Stream.STEP, step, where)
        system.sampler.update(step, system.field.density, generator)
        found, stats = system.compute_losses(batch, generator)
        loss = total_loss(found)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        if stats.counted:
            data.note_samples(stats.samples)
        losses.append(float(loss.detach()))
    return losses
