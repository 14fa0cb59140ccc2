"""Guard: notices that training has broken down, says why, and sets it going again."""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Annotated, Any

import lightning as L
import torch
from torch import Tensor

from nerf_lightning.callbacks.attached import data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.dataset import PixelDataModule, RayDataModule, ViewBatch, draw_rays
from nerf_lightning.model import Rectifier
from nerf_lightning.options import AtLeast, Count
from nerf_lightning.seeding import step_generator
from nerf_lightning.system import NeRF3D, System

MEMORY = 0.96
"""Of the running mean of the loss, a step: it looks back about 25 steps."""
AS_PLAIN = 0.85
"""Share of the error of one plain colour above which a field has not learned the scene."""
STANDING, HARDLY_FALLING = 0.98, 0.9
"""Shares of the error some steps ago above which it has not fallen since: below that of a plain colour, and above it."""
RISEN, WORSE = 4.0, 1.1
"""Times the lowest error seen, above which training is coming apart; and above which it must not stay ..."""
HALF_LEARNED = 0.3
"""... while the error is more than this share of that of one plain colour."""
EMPTY, FULL = 1e-3, 0.999
"""Mean opacity of rays below which there is no density, and above which there is nothing but density."""
LOWER, MUCH_LOWER = 0.3, 0.2
"""Factors on the learning rate where it is what is to blame: after something was learned, and where nothing ever was."""
WARM = 100
"""Steps in which the rate comes back after a new start, where it was to blame."""
PIXELS = 8192
"""Drawn to learn how well one plain colour would do."""


@dataclass(frozen=True)
class Recovery:
    """One time that training was set going again, for results.json."""

    step: int
    seconds: float
    cause: str
    action: str


def plain_error(data: RayDataModule | PixelDataModule, system: System) -> float:
    """The squared error of the best single colour on training pixels: what a field that shows nothing reaches."""
    if isinstance(data, RayDataModule):
        drawn = draw_rays(data.scene.train, PIXELS, step_generator(data.seed, 2, 0))
        truth = system.truth(ViewBatch(drawn.rays, drawn.pixels, 1, PIXELS))
    else:
        truth = system.truth(data.held_out(0))
    return float((truth - truth.mean(0)).square().mean())


class Guard(L.Callback):
    """Watches the loss, the density and the gradients, and acts where they say that nothing more will be learned.

    What it notices: a loss or weights that are no longer finite; a loss that rose to several times its lowest; a loss that
    stays at that of one plain colour, told apart by whether there is no density, density everywhere, or no gradient. What it
    does: back to the last good weights with a lower rate; or, where there was nothing good yet, a new start with fresh weights,
    with softplus in place of a rectifier that can die, else with a lower rate. Each time is printed and stands in results.json.

    It looks at weights and gradients only now and then, and at gradients only until the field has begun to learn. Of several
    processes none acts alone: there it does nothing.

    Args:
        attempts: how often it acts; 0 leaves training alone.
        every: steps between looks.
        patience: steps in which the loss must fall below that of a plain colour, or at least fall.
        keep_every: steps between copies of good weights.
    """

    def __init__(
        self,
        attempts: Annotated[int, AtLeast(0)] = 3,
        every: Count = 20,
        patience: Count = 100,
        keep_every: Count = 250,
    ):
        self.attempts = attempts
        self.every = every
        self.patience = patience
        self.keep_every = keep_every
        self.recoveries: list[Recovery] = []
        self.rate = 1.0
        self.softened = False
        self.began = 0
        """Step at which training last started."""
        self.level: float | None = None
        """The loss, averaged over the last steps."""
        self.earlier: list[float] = []
        """The same at the looks of the last `patience` steps."""
        self.lowest = math.inf
        self.plain = 0.0
        self._risen = 0
        self._dead = 0
        self._given_up = False
        self._start: dict[str, Tensor] = {}
        self._good: dict[str, Tensor] = {}

    # What Lightning calls

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        if stage == "fit" and self.attempts:
            self._start = copied(pl_module)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        with Budget.of(trainer).paused():
            self.plain = plain_error(data_of(trainer), pl_module)
        if isinstance(pl_module, NeRF3D):
            if self.began:
                pl_module.sampler.restart(self.began)
            if self.attempts and trainer.global_step == 0 and trainer.world_size == 1:
                self._slow_down(trainer, pl_module)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: System, batch: Any, batch_idx: int) -> None:
        since = trainer.global_step - self.began
        warm = min(1.0, (since + 1) / WARM) if self.began and self.rate < 1 else 1.0
        pl_module.rate = self.rate * warm

    def on_after_backward(self, trainer: L.Trainer, pl_module: System) -> None:
        if self._due(trainer.global_step + 1) and not self._learning():
            alive = any(p.grad is not None and bool(p.grad.any()) for p in pl_module.parameters())
            self._dead = 0 if alive else self._dead + 1

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._given_up or not self.attempts or trainer.world_size > 1:
            return
        step, error = trainer.global_step, pl_module.stats.mse
        if not math.isfinite(error):
            self._recover(trainer, pl_module, "the loss is no longer a finite number", lost=True)
            return
        self.level = error if self.level is None else MEMORY * self.level + (1 - MEMORY) * error
        if self._due(step):
            cause = self._cause(pl_module, step)
            if cause:
                self._recover(trainer, pl_module, cause, lost=self.lowest < AS_PLAIN * self.plain)
                return
            self.earlier = [*self.earlier, self.level][-(self.patience // self.every + 1) :]
            self.lowest = min(self.lowest, self.level)
        if step % self.keep_every == 0 and self._learning() and not self._risen:
            if finite(pl_module.parameters()):
                self._good = copied(pl_module)
            else:
                self._recover(trainer, pl_module, "weights are no longer finite numbers", lost=True)

    def state_dict(self) -> dict[str, Any]:
        return {
            "recoveries": [asdict(one) for one in self.recoveries],
            "rate": self.rate,
            "softened": self.softened,
            "began": self.began,
            "level": self.level,
            "earlier": self.earlier,
            "lowest": self.lowest,
            "risen": self._risen,
            "dead": self._dead,
            "given_up": self._given_up,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.recoveries = [Recovery(**one) for one in state_dict["recoveries"]]
        self.rate, self.began, self.level = state_dict["rate"], state_dict["began"], state_dict["level"]
        self.earlier, self.lowest, self.softened = state_dict["earlier"], state_dict["lowest"], state_dict["softened"]
        self._risen, self._dead, self._given_up = state_dict["risen"], state_dict["dead"], state_dict["given_up"]

    # How it decides

    def _due(self, step: int) -> bool:
        return step % self.every == 0

    def _learning(self) -> bool:
        """Whether the field has learned more than one plain colour."""
        return self.level is not None and self.level < AS_PLAIN * self.plain

    def _cause(self, system: System, step: int) -> str:
        """Why training has broken down; "" where it has not."""
        assert self.level is not None  # a step has been made
        risen = self.lowest < AS_PLAIN * self.plain and self.level > RISEN * self.lowest
        # A spike that passes is none of its business.
        stays = bool(self.earlier) and self.level > STANDING * self.earlier[-1]
        self._risen = self._risen + 1 if risen and stays else 0
        if self._risen >= 3:
            return f"the loss rose to {self.level / self.lowest:.0f} times its lowest"
        waited = step - self.began >= self.patience and len(self.earlier) > self.patience // self.every
        looks = [*self.earlier, self.level]
        if waited and min(looks[1:]) > max(WORSE * self.lowest, HALF_LEARNED * self.plain):
            return f"the loss fell to {self.lowest / self.plain:.2f} times that of one plain colour, and stays above that since"
        if self._learning() or not self.plain:
            return ""  # a scene of one colour is learned as soon as its colour is
        if self._dead < 2:  # without a gradient there is nothing to wait for
            falling = all(after < before for before, after in pairwise(looks))
            enough = HARDLY_FALLING if self.level > self.plain and not falling else STANDING
            if not waited or self.level < enough * looks[0]:
                return ""
        stuck = f"the loss stands at {self.level / self.plain:.2f} times that of one plain colour"
        opacity = system.stats.opacity
        if opacity is not None and opacity < EMPTY:
            return f"there is no density anywhere, so no gradient comes back; {stuck}"
        if self._dead:
            return f"no gradient reaches any weight; {stuck}"
        if opacity is not None and opacity > FULL:
            return f"there is density everywhere, a wall before every camera; {stuck}"
        return stuck

    # What it does

    def _recover(self, trainer: L.Trainer, system: System, cause: str, lost: bool) -> None:
        """`lost`: something was learned and is gone again; otherwise nothing ever was."""
        step = trainer.global_step
        if len(self.recoveries) >= self.attempts:
            self._given_up = True
            print(f"guard: step {step}: {cause}; given up after {self.attempts} attempts", flush=True)
            return
        if lost and self._good:
            system.load_state_dict(self._good)
            self.rate *= LOWER
            action = f"back to the last good weights, with {self.rate:.2g} times the learning rate"
        else:
            action = self._start_again(system, step, lost)
        forget(trainer)
        self.level, self.earlier, self.lowest, self._risen, self._dead = None, [], math.inf, 0, 0
        self._record(trainer, cause, action)

    def _record(self, trainer: L.Trainer, cause: str, action: str) -> None:
        step, seconds = trainer.global_step, round(Budget.of(trainer).seconds, 3)
        self.recoveries.append(Recovery(step, seconds, cause, action))
        print(f"guard: step {step}: {cause}; {action}", flush=True)

    def _slow_down(self, trainer: L.Trainer, system: NeRF3D) -> None:
        """Before the first step, where the rate is one at which the field is known to come apart."""
        asked, fastest = trainer.optimizers[0].param_groups[0]["initial_lr"], system.field.fastest
        if asked > fastest:
            self.rate = fastest / asked
            cause = f"a learning rate of {asked:.3g} is more than this field stands ({fastest:.3g})"
            self._record(trainer, cause, f"{self.rate:.2g} times the learning rate")

    def _start_again(self, system: System, step: int, lost: bool) -> str:
        """Fresh weights, and something else besides, as the same again would come to the same end."""
        system.load_state_dict(self._start)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(step_generator(system.seed, 3, step).initial_seed() & 0xFFFFFFFF))
            for module in reversed(
                list(system.modules())
            ):  # layers first: a field may have a start of its own for them
                reset = getattr(module, "reset_parameters", None)
                if reset is not None:
                    reset()
        system.on_fit_start()  # what a sampler finds out about the scene is part of a start
        if isinstance(system, NeRF3D):
            system.sampler.restart(step)
        self.began = step
        rectifiers = [module for module in system.modules() if isinstance(module, Rectifier)]
        if rectifiers and not self.softened and not lost:
            self.softened = True
            action = "started again with softplus in place of the rectifier that makes the density"
        else:
            self.rate *= LOWER if lost else MUCH_LOWER
            action = f"started again with {self.rate:.2g} times the learning rate"
        if self.softened:
            for one in rectifiers:
                one.soften()
        return action


def copied(module: torch.nn.Module) -> dict[str, Tensor]:
    """A copy of all weights and buffers."""
    return {key: value.detach().clone() for key, value in module.state_dict().items()}


def finite(parameters: Iterable[torch.nn.Parameter]) -> bool:
    """Whether all weights are numbers; a sum shows any that is not, and costs one reading."""
    return all(math.isfinite(float(parameter.detach().sum())) for parameter in parameters)


def forget(trainer: L.Trainer) -> None:
    """Empties what optimisers remember of gradients."""
    for optimizer in trainer.optimizers:
        optimizer.state.clear()
        optimizer.zero_grad()
