"""NeRF3D: fit a radiance field to rays."""

import copy
import math
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from statistics import fmean
from typing import Any

import torch
from lightning.pytorch.strategies import DDPStrategy
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset import RayBatch, RayDataModule, ViewBatch
from nerf_lightning.model import Field
from nerf_lightning.refine import Corrections
from nerf_lightning.renderer import Rendered, VolumeRenderer, over
from nerf_lightning.sampler import Sampler, split
from nerf_lightning.system.compiled import part
from nerf_lightning.system.system import CHUNK, MakeOptimizer, Schedule, StepStats, System
from nerf_lightning.system.trial import See, worth
from nerf_lightning.utils.seeding import Stream, step_generator

MIGHT, DRAWS = 0.5, 4
"""Share of what corrections have to explain from which on this many draws of pixels decide, by their mean."""
FOUND = 16
"""Samples that are found together without gradient before they are rendered, as multiples of `chunk`."""


class NeRF3D(System):
    """sampler -> field -> renderer -> squared error.

    Args:
        field: position, direction -> density, rgb.
        sampler: rays -> samples.
        renderer: samples -> pixels.
        corrections: of the training photos' cameras and light, learned with the field; None takes them as they are.
        optimizer, schedule, seed, chunk: see `System`.
    """

    field: Field

    def __init__(
        self,
        field: Field,
        sampler: Sampler,
        renderer: VolumeRenderer,
        optimizer: MakeOptimizer,
        schedule: Schedule,
        seed: int = 0,
        chunk: int = CHUNK,
        corrections: Corrections | None = None,
    ):
        super().__init__(optimizer, schedule, seed, chunk)
        self.field = field
        self.sampler = sampler
        self.sampler.chunk = chunk
        self.renderer = renderer
        self.corrections = corrections

    def learned(self) -> list[dict[str, Any]]:
        groups = [*self.sampler.groups, *(self.corrections.groups if self.corrections is not None else [])]
        apart = {parameter for group in groups for parameter in group["params"]}
        return [{"params": [p for p in self.parameters() if p not in apart]}, *groups]

    def warm_start_from(self, smaller: System) -> None:
        super().warm_start_from(smaller)
        assert isinstance(smaller, NeRF3D)  # checked by the field
        self.sampler.warm_start_from(smaller.sampler)
        self.sampler.refine(self.field.finer)

    @property
    def data(self) -> RayDataModule:
        """What it trains on."""
        return self.trainer.datamodule  # type: ignore[attr-defined]

    def on_fit_start(self) -> None:
        if self.trainer.ckpt_path is None:  # what is resumed has looked already
            self.sampler.look_through(self.data.scene.train.cameras)
        self.data.plain = self.renderer.prices_plain
        self.follow_field(self.data)

    def follow_field(self, data: RayDataModule) -> None:
        """Steps along rays, and samples a step of the data, for a field as fine as it is now."""
        self.sampler.refine(self.field.finer)
        data.finer = self.field.finer

    def on_train_batch_start(self, batch: RayBatch, batch_idx: int) -> None:
        super().on_train_batch_start(batch, batch_idx)
        if self.corrections is not None:
            if self.corrections.due(self.global_step, self.progress):
                self.try_corrections()
            factors = self.corrections.factors(self.progress)
            ours = self.parameter_groups[-len(factors) :]  # the last, see `learned`; there is at least one
            for group, factor in zip(ours, factors, strict=True):
                group["lr"] = group["initial_lr"] * factor * self.rate
        self.renderer.fade(self.progress)
        ripe = self.ripeness(self.global_step)
        if self.trainer.world_size > 1 and self.field.grows_at(ripe):
            for buffer in self.buffers():  # each process has seen rays of its own, and all must grow alike
                torch.distributed.broadcast(buffer, 0)
        replaced = self.field.grow(ripe)
        if replaced:
            self.follow_field(self.data)
            optimizer = self.optimizers(use_pl_optimizer=False)
            assert isinstance(optimizer, torch.optim.Optimizer)  # configure_optimizers makes exactly one
            for parameter in replaced:
                optimizer.state.pop(parameter, None)
            if isinstance(self.trainer.strategy, DDPStrategy):  # it has made room for gradients of the old size
                self.trainer.strategy.model = self
                self.trainer.strategy.configure_ddp()
            if self.backend is not None:
                self.rehearse(batch)

    def ripeness(self, step: int) -> float:
        """The share of the budget by which the field is to grow: behind `progress` where it has not taken the steps that its
        sizes need, or where corrections are still coming; ahead of it where its sizes have had all the steps that help them."""
        field, ripe = self.field, self.progress
        if self.corrections is not None:
            ripe = self.corrections.ripeness(ripe, field.grown_after)
        else:
            ripe = max(ripe, field.grown_after * min(1.0, step / field.growing_steps_most))
        if step < field.growing_steps:
            ripe = min(ripe, field.grown_after * step / field.growing_steps)
        return ripe

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if self.corrections is not None:
            checkpoint["corrections"] = self.corrections.decided()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if self.corrections is not None:
            self.corrections.decide(checkpoint["corrections"])
        expected = self.learned()
        for state in checkpoint["optimizer_states"]:
            saved = state["param_groups"]
            if len(saved) < len(expected):  # from when samplers learned in the field's group: it goes on at that rate
                count = len(expected[0]["params"])
                parts = saved[0]["params"][:count], saved[0]["params"][count:]
                state["param_groups"] = [*({**saved[0], "params": part} for part in parts), *saved[1:]]

    def as_it_is(self) -> See:
        """Renders without randomness and with gradient in the rays alone: the field does not learn from it."""
        field, renderer = copy.deepcopy(self.field).requires_grad_(False), copy.deepcopy(self.renderer).eval()

        def see(rays: Rays, behind: Tensor) -> Rendered:
            with torch.no_grad():
                samples = self.sampler(rays.detach(), field.density)
            return renderer(rays, samples, field, behind)

        return see

    def try_corrections(self) -> None:
        """Corrects cameras and light from now on, if that would help; where it might, more pixels are asked."""
        corrections = self.corrections
        assert corrections is not None  # asked for by the caller
        views, generator = (
            self.data.scene.train.to(self.device),
            step_generator(self.seed, Stream.TRIAL, self.global_step, self.device),
        )
        light = "light" in corrections.open_at(self.global_step)
        ask = partial(worth, self.as_it_is(), views, self.renderer.colour, corrections, generator, light)
        found = ask()
        if corrections.helps(self.global_step, found, MIGHT):
            several = [found, *(ask() for _ in range(DRAWS - 1))]
            found = {name: fmean(one[name] for one in several) for name in found}
        corrections.note(self.global_step, self.progress, found)

    def rehearse(self, batch: RayBatch) -> None:
        """Runs a step on a copy with the clock stopped: compiling for a new size does not count as training."""
        field, sampler = copy.deepcopy(self.field), copy.deepcopy(self.sampler)
        options = self.make_optimizer, self.schedule, self.seed, self.chunk, self.corrections
        trial = NeRF3D(field, sampler, self.renderer, *options)
        trial.backend = self.backend
        with self.paused() if self.paused else nullcontext(), self.trainer.precision_plugin.train_step_context():
            trial.loss(batch, step_generator(self.seed, Stream.STEP, self.global_step, self.device), 1)[0].backward()

    def loss(self, batch: RayBatch, generator: torch.Generator, step: int) -> tuple[Tensor, StepStats]:
        """What a step minimises, and what it did. All its randomness comes from `generator`."""
        rays, corrections = batch.rays, self.corrections
        if corrections is not None:
            assert batch.views is not None  # training rays are of photos
            rays = corrections.rays(rays, batch.views)
        with torch.no_grad():
            density = part(self.field.density, self.backend)
            self.sampler.update(step, density, generator)
            samples = self.sampler(rays.detach(), density, generator)
        backgrounds = self.renderer.backgrounds(len(batch.rays), generator)
        field = self.field.with_view_part if self.renderer.view_loss_weight else self.field
        rendered = part(self.renderer.forward, self.backend)(rays, samples, field, backgrounds, batch.plain)
        truth, rgb = over(batch.pixels, backgrounds), rendered.rgb
        if corrections is not None:
            assert batch.views is not None
            rgb = corrections.lit(rgb, rendered.opacity, backgrounds, batch.rays, batch.views, truth)
        # A ray without all of its samples must not be learned from.
        rgb = rgb if samples.whole is None else torch.where(samples.whole[:, None], rgb, truth)
        squares = (rgb - truth).square().mean(1)
        loss = (squares if batch.weights is None else squares * batch.weights).mean()
        learned = None if rendered.weights is None else self.sampler.loss(samples, rendered.weights)
        added = {"field": self.field.penalty(), "rays": rendered.penalty, "sampler": learned}
        terms = {"rgb": loss, **{name: term for name, term in added.items() if term is not None}}
        stats = StepStats(
            loss.detach(),
            len(batch.rays),
            len(samples),
            rendered.opacity.detach(),
            squares.detach(),
            samples.whole,
            {name: term.detach() for name, term in terms.items()},
        )
        for name, term in terms.items():
            loss = loss if name == "rgb" else loss + term
        return loss, stats

    def training_step(self, batch: RayBatch, batch_idx: int) -> Tensor:
        generator = step_generator(self.seed, Stream.STEP, self.global_step, self.device)
        loss, self.stats = self.loss(batch, generator, self.global_step)
        self.note_errors()
        if not self.stats.counted:
            return loss
        drawn = self.stats.samples
        if self.trainer.world_size > 1:  # all processes draw from one stream, so they must adapt in the same way
            drawn = int(self.trainer.strategy.reduce(torch.tensor(drawn, device=self.device), reduce_op="sum"))
        self.data.note_samples(drawn)
        return loss

    def note_errors(self) -> None:
        """Tells the data how wrong each ray of the last step was: of all processes, since each draws for all."""
        errors, counted = self.stats.squares, self.stats.whole
        assert errors is not None  # a step of this system
        world, rays = self.trainer.world_size, self.data.rays
        if world > 1 and self.data.focus:  # else nobody asks
            both = torch.stack([errors, torch.ones_like(errors) if counted is None else counted.float()])
            padded = torch.nn.functional.pad(both, (0, -(-rays // world) - len(errors)))
            gathered = self.all_gather(padded)
            assert isinstance(gathered, Tensor)  # as what was given
            # Process p has the rays p, p + world, p + 2 world, ...
            errors, counted = gathered.permute(1, 2, 0).flatten(1)[:, :rays]
            counted = counted > 0
        self.data.note_errors(errors, counted)

    @property
    def chunk_rays(self) -> int:
        """Rays sampled together without gradient."""
        return self.sampler.rays_at_once

    @torch.no_grad()
    def render(
        self, rays: Rays, near: float = 0.0, far: float = math.inf, background: Sequence[float] | None = None
    ) -> Rendered:
        """Renders rays without gradient and without randomness, a chunk at a time.

        Args:
            rays: on the system's device.
            near, far: distances along each ray, scene's unit; nothing nearer or farther is seen.
            background: colour in [0, 1]; None takes the renderer's own.
        """
        behind = self.renderer.colour if background is None else torch.tensor(background, device=self.device)
        parts, start, many = [], 0, self.chunk_rays
        while start < len(rays):
            chunk = rays[start : start + many]
            found = self.sampler(chunk, self.field.density)
            # Fog, which an early field is full of, leaves many times more along a ray than a surface does.
            many = max(1, min(self.chunk_rays, FOUND * self.chunk * len(chunk) // max(1, len(found.t))))
            start += len(chunk)
            if near > 0 or far < math.inf:
                found = found.between(near, far)
            for run, samples in split(found.merged(), self.chunk):
                part_rays = chunk[run]
                parts.append(self.renderer(part_rays, samples, self.field, behind.expand(len(part_rays), 3)))
        return Rendered(
            *(torch.cat([getattr(part, name) for part in parts]) for name in ("rgb", "opacity", "distance"))
        )

    @property
    def background(self) -> list[float]:
        return [round(c, 3) for c in self.renderer.colour.tolist()]

    def truth(self, batch: RayBatch) -> Tensor:
        return over(batch.pixels, self.renderer.backgrounds(len(batch.rays)))

    def show(self, view: ViewBatch) -> tuple[Tensor, Tensor, Tensor]:
        rendered = self.render(view.rays)
        return rendered.rgb, rendered.depth, rendered.opacity
