"""NeRF3D: fits a radiance field to rays."""

import math
from collections.abc import Sequence
from typing import Any

import lightning as L
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset import RayBatch, RayDataModule, ViewBatch
from nerf_lightning.model import Field
from nerf_lightning.refine import Corrections
from nerf_lightning.renderer import RenderOutput, VolumeRenderer, composite_over
from nerf_lightning.renderer.background import random_color_error
from nerf_lightning.sampler import CHUNK, Sampler, Samples, split_by_rays
from nerf_lightning.system.correction_trial import CorrectionTrials
from nerf_lightning.system.growth import FieldGrowth, sync_resolution_scale
from nerf_lightning.system.state import TrainingState
from nerf_lightning.system.system import OptimizerFactory, Schedule, StepStats, System, sum_losses
from nerf_lightning.system.torch_compile import maybe_compile
from nerf_lightning.utils.seeding import Stream, step_generator

ADAPT_EVERY = 16
"""Steps between adaptations of the number of rays on several devices, each of which has to wait for the others' counts."""
SAMPLE_CHUNKS_PER_PASS = 16
"""Samples drawn at once without gradient, in multiples of `chunk`."""


class NeRF3D(System):
    """Radiance field training: sampler -> field -> renderer -> squared error.

    Args:
        field: position, direction -> density, rgb.
        sampler: rays -> samples.
        renderer: samples -> pixels.
        corrections: refinement of training cameras and exposure, learned with the field; None keeps them as given.
        optimizer, schedule, seed, chunk, compile_backend, state: see `System`.
    """

    field: Field

    def __init__(
        self,
        field: Field,
        sampler: Sampler,
        renderer: VolumeRenderer,
        optimizer: OptimizerFactory,
        schedule: Schedule,
        seed: int = 0,
        chunk: int = CHUNK,
        corrections: Corrections | None = None,
        compile_backend: str | None = None,
        state: TrainingState | None = None,
    ):
        super().__init__(field, optimizer, schedule, seed, chunk, compile_backend, state)
        self.sampler = sampler
        self.renderer = renderer
        self.corrections = corrections

    def param_groups(self) -> list[dict[str, Any]]:
        groups = [*self.sampler.param_groups(), *(self.corrections.param_groups() if self.corrections else [])]
        grouped = {parameter for group in groups for parameter in group["params"]}
        return [{"name": "field", "params": [p for p in self.parameters() if p not in grouped]}, *groups]

    def lr_factors(self, progress: float, step: int) -> dict[str, float]:
        scheduled = {"field": 1.0, **self.sampler.lr_factors(progress)}
        factors = {name: self.schedule(progress, step) * factor for name, factor in scheduled.items()}
        return factors if self.corrections is None else {**factors, **self.corrections.lr_factors(progress)}

    def warm_start_from(self, source: "NeRF3D") -> None:
        super().warm_start_from(source)
        self.sampler.warm_start_from(source.sampler)
        self.sampler.set_resolution_scale(self.field.resolution_scale)

    @property
    def datamodule(self) -> RayDataModule:
        """The trainer's data module."""
        return self.trainer.datamodule  # type: ignore[attr-defined]

    def configure_callbacks(self) -> list[L.Callback]:
        """Adds correction trials and field growth."""
        return [CorrectionTrials(), FieldGrowth()]

    def on_fit_start(self) -> None:
        if self.trainer.ckpt_path is None:  # a checkpoint holds the marks
            self.sampler.mark_invisible_cells(self.datamodule.scene.train.cameras)
        self.datamodule.enable_texturelessness(self.renderer.is_texture_weighted)
        sync_resolution_scale(self, self.datamodule)

    def set_first_step(self, step: int) -> None:
        self.sampler.restart(step)

    def restart(self, step: int) -> None:
        self.set_first_step(step)
        self.sampler.mark_invisible_cells(self.datamodule.scene.train.cameras)
        sync_resolution_scale(self, self.datamodule)
        self.datamodule.reset()  # the errors were those of the failed attempt

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if self.corrections is not None:
            checkpoint["corrections"] = self.corrections.trial_state()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if self.corrections is not None:
            self.corrections.load_trial_state(checkpoint["corrections"])

    def training_step(self, batch: RayBatch, batch_idx: int) -> Tensor:
        step = self.global_step
        generator = step_generator(self.seed, Stream.STEP, step, self.device)
        self.sampler.update(step, maybe_compile(self.field.density, self.compile_backend), generator)
        losses, self.stats = self.compute_losses(batch, generator)
        self.update_error_map()
        self.adapt_num_rays()
        return sum_losses(losses)

    def compute_losses(self, batch: RayBatch, generator: torch.Generator) -> tuple[dict[str, Tensor], StepStats]:
        """Losses of a step by name, and its statistics. All randomness comes from `generator`."""
        rays = batch.rays
        if self.corrections is not None:
            assert batch.views is not None  # training batches have views
            rays = self.corrections.poses(rays, batch.views)
        with torch.no_grad():
            samples = self.sampler(rays.detach(), maybe_compile(self.field.density, self.compile_backend), generator)
        backgrounds = self.renderer.background.expand(len(rays), is_training=True)
        output = maybe_compile(self.renderer.forward, self.compile_backend)(rays, samples, self.field, backgrounds)
        truth, rgb = composite_over(batch.pixels, backgrounds), output.rgb
        if self.corrections is not None:
            assert batch.views is not None
            rgb = self.corrections.color(rgb, output.opacity, backgrounds, batch.rays, batch.views, truth)
        squared_errors = (rgb - truth).square().mean(1)
        if self.renderer.background.is_random:
            squared_errors = random_color_error(squared_errors, output.opacity, batch.pixels[:, 3] / 255)
        if samples.complete is not None:  # truncated rays must not contribute
            squared_errors = torch.where(samples.complete, squared_errors, 0.0)
        losses = {
            "photometric": (squared_errors if batch.weights is None else squared_errors * batch.weights).mean(),
            **self.regularize(output, samples, batch),
        }
        per_ray = self.sampler.samples_per_ray
        stats = StepStats(
            losses["photometric"].detach(),
            len(rays),
            len(samples) if per_ray is None else round(per_ray * len(rays)),
            output.opacity.detach(),
            squared_errors.detach(),
            samples.complete,
            {name: loss.detach() for name, loss in losses.items()},
        )
        return losses, stats

    def regularize(self, output: RenderOutput, samples: Samples, batch: RayBatch) -> dict[str, Float[Tensor, ""]]:
        """Regularization losses of field, renderer and sampler, by name."""
        return {
            **self.field.losses(),
            **self.renderer.losses(output, samples, self.state.progress, batch.texturelessness),
            **self.sampler.losses(samples, output.weights),
        }

    def adapt_num_rays(self) -> None:
        """Adapts the number of rays per step to the samples that the last step drew."""
        drawn = self.stats.samples
        if self.trainer.world_size > 1:  # all processes draw from one stream, so they must adapt in the same way
            if self.stats.complete_rays is not None and self.global_step % ADAPT_EVERY:
                return
            drawn = int(self.trainer.strategy.reduce(torch.tensor(drawn, device=self.device), reduce_op="sum"))
        self.datamodule.adapt_num_rays(drawn)

    def update_error_map(self) -> None:
        """Updates the data's error map with the last step's squared errors."""
        errors, complete = self.stats.squared_errors, self.stats.complete_rays
        assert errors is not None  # set by `compute_losses`
        if self.trainer.world_size > 1 and self.datamodule.error_sampling:  # otherwise unused
            errors, complete = self._gather_errors(errors, complete)
        self.datamodule.update_error_map(errors, complete)

    def _gather_errors(
        self, errors: Float[Tensor, "r"], complete: Bool[Tensor, "r"] | None
    ) -> tuple[Float[Tensor, "R"], Bool[Tensor, "R"]]:
        """Gathers the ray errors of all processes: process p has rays p, p + world, p + 2 world, ..."""
        world, rays = self.trainer.world_size, self.datamodule.rays
        stacked = torch.stack([errors, torch.ones_like(errors) if complete is None else complete.float()])
        padded = torch.nn.functional.pad(stacked, (0, -(-rays // world) - len(errors)))
        gathered = self.all_gather(padded)
        assert isinstance(gathered, Tensor)  # one tensor in, one out
        errors, counted = gathered.permute(1, 2, 0).flatten(1)[:, :rays]
        return errors, counted > 0

    @property
    def chunk_rays(self) -> int:
        """Rays sampled together without gradient."""
        return self.sampler.ray_chunk_size

    @torch.no_grad()
    def render(
        self, rays: Rays, near: float = 0.0, far: float = math.inf, background: Sequence[float] | None = None
    ) -> RenderOutput:
        """Renders rays without gradient or randomness, in chunks.

        Args:
            rays: on the system's device.
            near, far: visible range along each ray, in scene units.
            background: color in [0, 1]; None takes the renderer's.
        """
        color = self.renderer.background.color if background is None else torch.tensor(background, device=self.device)
        outputs, start, num_rays, max_samples = [], 0, self.chunk_rays, SAMPLE_CHUNKS_PER_PASS * self.chunk
        while start < len(rays):
            chunk = rays[start : start + num_rays]
            samples = self.sampler(chunk, self.field.density)
            # An early field is fog, which keeps many times more samples along a ray than a surface does.
            num_rays = max(1, min(self.chunk_rays, max_samples * len(chunk) // max(1, len(samples.t))))
            start += len(chunk)
            if near > 0 or far < math.inf:
                samples = samples.clip(near, far)
            for span, part in split_by_rays(samples.merge_low_weight_samples(), self.chunk):
                outputs.append(self.renderer(chunk[span], part, self.field, color.expand(len(chunk[span]), 3)))
        names = ("rgb", "opacity", "distance")
        return RenderOutput(*(torch.cat([getattr(output, name) for output in outputs]) for name in names))

    @property
    def background(self) -> list[float]:
        return [round(c, 3) for c in self.renderer.background.color.tolist()]

    def compute_target_rgb(self, batch: RayBatch) -> Tensor:
        return composite_over(batch.pixels, self.renderer.background.expand(len(batch.rays)))

    def render_view(self, view: ViewBatch) -> tuple[Tensor, Tensor, Tensor]:
        rendered = self.render(view.rays)
        return rendered.rgb, rendered.depth, rendered.opacity
