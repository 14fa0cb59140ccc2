"""Renders: callbacks that render views, in the time that the run has for them."""

import lightning as L

from nerf_lightning.callbacks.attached import data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.render_plan import PROBE_PIXELS, allot
from nerf_lightning.dataset.subset import thin
from nerf_lightning.system import System


class Renders(L.Callback):
    """A callback that renders views."""

    weight = 1.0
    """Of its time, where there is not enough for all."""
    in_full = False
    """Whether it renders all its pixels, in time of its own."""

    def pixels_left(self, trainer: L.Trainer) -> float:
        """Pixels that are still to be rendered, where there is time for all."""
        raise TypeError(f"{type(self).__name__} must define pixels_left(trainer)")

    def share(self, trainer: L.Trainer, system: System, pixels: float | None = None) -> float:
        """The share of so many pixels for which there is time; None takes all that are left."""
        plan, data = Budget.of(trainer).plan, data_of(trainer)
        if plan.pixel_seconds is None:
            some = thin(data.pixels_held_out(0), PROBE_PIXELS)
            with Budget.of(trainer).rendering(trainer, "a first look"):
                (view,) = system.evaluate_held_out(data, [0], some)
            plan.note(view.pixels, view.seconds)
        cost = (self.pixels_left(trainer) if pixels is None else pixels) * (plan.pixel_seconds or 0.0)
        return min(1.0, _divide(trainer)[self] / cost) if cost else 1.0


def _divide(trainer: L.Trainer) -> dict[Renders, float]:
    """Seconds that each callback may still render."""
    budget = Budget.of(trainer)
    jobs = [one for one in trainer.callbacks if isinstance(one, Renders)]  # type: ignore[attr-defined]
    costs = {one: one.pixels_left(trainer) * (budget.plan.pixel_seconds or 0.0) for one in jobs}
    bounded, weights = {one: costs[one] for one in jobs if not one.in_full}, {one: one.weight for one in jobs}
    return costs | allot(bounded, weights, budget.render_seconds(trainer.global_step) - budget.plan.spent)


def render_seconds_left(trainer: L.Trainer) -> float | None:
    """Seconds of rendering still to come; None before the first view."""
    return None if Budget.of(trainer).plan.pixel_seconds is None else sum(_divide(trainer).values())
