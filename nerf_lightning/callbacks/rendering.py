"""Renders: callbacks that render views, in the time that the run's RenderPlan gives them."""

import time

import lightning as L

from nerf_lightning.callbacks.attached import data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.render_plan import PROBE_PIXELS, Need
from nerf_lightning.dataset.subset import thin
from nerf_lightning.system import System, ssim


class Renders(L.Callback):
    """A callback that renders views."""

    def needs(self, trainer: L.Trainer) -> dict[str, Need]:
        """What is still to be rendered, by job."""
        raise TypeError(f"{type(self).__name__} must define needs(trainer)")


def needs_of(trainer: L.Trainer) -> dict[str, Need]:
    """What all callbacks still have to render, by job."""
    found: dict[str, Need] = {}
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, Renders):
            found |= callback.needs(trainer)
    return found


def share_of(trainer: L.Trainer, system: System, job: str) -> float:
    """The share of its pixels that a job may render now, one of the plan's jobs that a callback of the trainer needs."""
    budget = Budget.of(trainer)
    if budget.plan.pixel_seconds is None:
        _probe(trainer, system)
    return budget.plan.share(job, needs_of(trainer), budget.render_seconds(trainer.global_step))


def render_seconds_left(trainer: L.Trainer) -> float | None:
    """Seconds of rendering still to come; None before the first view."""
    budget = Budget.of(trainer)
    return budget.plan.seconds_left(needs_of(trainer), budget.render_seconds(trainer.global_step))


def _probe(trainer: L.Trainer, system: System) -> None:
    """Measures how long pixels of a small view take."""
    budget, data = Budget.of(trainer), data_of(trainer)
    with budget.rendering(trainer, "a first look"):
        some = thin(data.pixels_held_out(0), PROBE_PIXELS)
        (view,) = system.evaluate_held_out(data, [0], some)
        budget.plan.note(view.pixels, view.seconds)
        start = time.perf_counter()
        ssim(view.rgb, view.truth)
        budget.plan.score_seconds = (time.perf_counter() - start) / view.pixels
