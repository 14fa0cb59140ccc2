"""NeRF3D: fits a radiance field to rays."""

import functools
import math
from collections.abc import Sequence
from typing import Any

import lightning as L
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset import RayBatch, RayDataModule, ViewBatch
from nerf_lightning.dataset.ray_datamodule import STEPS_PER_DRAW
from nerf_lightning.kernels import compare_colors, photometric_loss
from nerf_lightning.kernels.backend import get_kernels
from nerf_lightning.model import Field
from nerf_lightning.refine import Corrections
from nerf_lightning.renderer import RenderOutput, VolumeRenderer, composite_over, render_checkerboard
from nerf_lightning.sampler import CHUNK, Sampler, Samples, split_by_rays
from nerf_lightning.system.correction_trial import CorrectionTrials
from nerf_lightning.system.growth import FieldGrowth, sync_resolution_scale
from nerf_lightning.system.state import TrainingState
from nerf_lightning.system.step_graph import StepGraph, list_addresses
from nerf_lightning.system.system import OptimizerFactory, Schedule, StepStats, System, sum_losses
from nerf_lightning.utils.seeding import Stream, step_generator

SAMPLE_CHUNKS_PER_PASS = 16
"""Samples drawn at once without gradient, in multiples of `chunk`."""


class NeRF3D(System):
    """Radiance field training: sampler -> field -> renderer -> squared error.

    Args:
        field: position, direction -> density, rgb.
        sampler: rays -> samples.
        renderer: samples -> pixels.
        corrections: refinement of training cameras and exposure, learned with the field; None keeps them as given.
        optimizer, schedule, seed, chunk, state: see `System`.
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
        state: TrainingState | None = None,
    ):
        super().__init__(field, optimizer, schedule, seed, chunk, state)
        self.sampler = sampler
        self.renderer = renderer
        self.corrections = corrections
        self.step_graph: StepGraph | None = None

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

    def training_step(self, batch: RayBatch, batch_idx: int) -> Tensor | None:
        """Computes the loss; None if the step's graph has already done the whole step."""
        step, loss = self.global_step, None
        generator = step_generator(self.seed, Stream.STEP, step, self.device)
        self.sampler.update(step, self.field.density, generator)
        stats = self._replay_step(batch, generator.initial_seed()) if self.is_graphable else None
        if stats is None:
            losses, stats = self.compute_losses(batch, generator)
            loss = sum_losses(losses)
        self.stats = stats
        self.update_error_map()
        self.adapt_num_rays()
        return loss

    @property
    def is_graphable(self) -> bool:
        """Whether steps may run as CUDA graphs: on one NVIDIA GPU, in single precision, without enabled corrections."""
        is_plain = self.device.type == "cuda" and get_kernels() == "auto" and not self.is_corrected
        trainer = self._trainer  # None in steps without one
        return is_plain and trainer is not None and trainer.precision == "32-true" and trainer.world_size == 1

    def _replay_step(self, batch: RayBatch, seed: int) -> StepStats | None:
        """Runs the step as a CUDA graph; None if it has to run by itself."""
        optimizer = self.trainer.optimizers[0]
        optimizer.zero_grad()  # those of the last step, which Lightning would apply again
        sampler_key = self.sampler.graph_key
        # Numbers that follow progress are constant between draws.
        key = None if sampler_key is None else (self.global_step // STEPS_PER_DRAW, len(batch.rays), sampler_key)
        self.step_graph = self.step_graph or StepGraph(self.device, self._run_step, self.compute_losses)
        return self.step_graph.run(key, list_addresses(self, optimizer), batch, seed)

    def _run_step(self, batch: RayBatch, generator: torch.Generator) -> StepStats:
        losses, stats = self.compute_losses(batch, generator)
        sum_losses(losses).backward()
        self.trainer.optimizers[0].step()
        self.trainer.optimizers[0].zero_grad()
        return stats

    def compute_losses(self, batch: RayBatch, generator: torch.Generator) -> tuple[dict[str, Tensor], StepStats]:
        """Losses of a step by name, and its statistics. All randomness comes from `generator`."""
        rays = batch.rays
        if self.corrections is not None:
            assert batch.views is not None  # training batches have views
            rays = self.corrections.poses(rays, batch.views)
        with torch.no_grad():
            samples = self.sampler(rays.detach(), self.field.density, generator)
        backgrounds = self.renderer.background.expand(len(rays), is_training=True)
        output = self.renderer(rays, samples, self.field, backgrounds)
        options = batch.weights, samples.complete, self.renderer.background.variance
        if self.corrections is None:
            colors = output.foreground, output.opacity, backgrounds, batch.pixels
            loss, on_opacity, squared_errors = photometric_loss(*colors, *options)
        else:
            assert batch.views is not None
            truth = composite_over(batch.pixels, backgrounds)
            rgb = self.corrections.color(output.rgb, output.opacity, backgrounds, batch.rays, batch.views, truth)
            loss, on_opacity, squared_errors = compare_colors(rgb, truth, output.opacity, batch.pixels, *options)
        losses = {"photometric": loss, **self.regularize(output, samples, batch)}
        if on_opacity is not None:
            losses["opacity"] = on_opacity
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
        """Adapts the number of rays per step to the samples that the last step drew; on accelerators before a new draw."""
        steps = 1 if self.device.type == "cpu" else STEPS_PER_DRAW
        if (self.global_step + 1) % steps:
            return
        self.sampler.read_counts()
        per_ray = self.sampler.samples_per_ray
        drawn = self.stats.samples if per_ray is None else round(per_ray * self.stats.rays)
        if self.trainer.world_size > 1:  # all processes draw from one stream, so they must adapt in the same way
            drawn = int(self.trainer.strategy.reduce(torch.tensor(drawn, device=self.device), reduce_op="sum"))
        self.datamodule.adapt_num_rays(drawn, steps)

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
        self,
        rays: Rays,
        near: float = 0.0,
        far: float = math.inf,
        background: Sequence[float] | None = None,
        width: int = 1,
    ) -> RenderOutput:
        """Renders rays without gradient or randomness, in chunks.

        Args:
            rays: on the system's device.
            near, far: visible range along each ray, in scene units.
            background: color in [0, 1]; None takes the renderer's.
            width: of the view whose rows the rays are, which lets unbounded scenes interpolate smooth pixels.
        """
        color = self.renderer.background.color if background is None else torch.tensor(background, device=self.device)
        march = functools.partial(self._march, near=near, far=far)
        is_view = self.renderer.unbounded and 1 < width < len(rays)
        values = render_checkerboard(march, rays, width) if is_view else march(rays)
        return RenderOutput(values[:, :3], values[:, 3], values[:, 4], color.expand(len(rays), 3))

    def _march(self, rays: Rays, near: float, far: float) -> Float[Tensor, "R 5"]:
        """Foreground color, opacity and distance of rays."""
        values, start, num_rays, max_samples = [], 0, self.chunk_rays, SAMPLE_CHUNKS_PER_PASS * self.chunk
        chunk_samples = self.chunk * (self.field.cpu_chunks if self.device.type == "cpu" else 1)
        while start < len(rays):
            chunk = rays[start : start + num_rays]
            samples = self.sampler(chunk, self.field.density)
            # An early field is fog, which keeps many times more samples along a ray than a surface does.
            num_rays = max(1, min(self.chunk_rays, max_samples * len(chunk) // max(1, len(samples.t))))
            start += len(chunk)
            if near > 0 or far < math.inf:
                samples = samples.clip(near, far)
            for span, part in split_by_rays(samples.merge_low_weight_samples(), chunk_samples):
                output = self.renderer(chunk[span], part, self.field)
                values.append(torch.cat([output.foreground, output.opacity[:, None], output.distance[:, None]], 1))
        return torch.cat(values) if values else rays.origins.new_zeros(0, 5)

    @property
    def background(self) -> list[float]:
        return [round(c, 3) for c in self.renderer.background.color.tolist()]

    def compute_target_rgb(self, batch: RayBatch, is_training: bool = False) -> Tensor:
        return composite_over(batch.pixels, self.renderer.background.expand(len(batch.rays), is_training))

    def render_view(self, view: ViewBatch) -> tuple[Tensor, Tensor, Tensor]:
        rendered = self.render(view.rays, width=view.width if view.strip is None else 1)
        return rendered.rgb, rendered.depth, rendered.opacity
