"""Guard: notices that training has broken down, says why, and sets it going again."""

import copy
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import lightning as L
import torch
from torch import Tensor

from nerf_lightning.callbacks.attached import data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.watch import Breakdown, Watch
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.model import Rectifier
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.options import AtLeast, Count
from nerf_lightning.utils.seeding import Stream, step_generator

LOWER, MUCH_LOWER = 0.3, 0.2
"""Factors on the learning rate where it is what is to blame: after something was learned, and where nothing was."""
WARM = 100
"""Steps in which the rate comes back after a new start, where it was to blame ..."""
COOL = 0.1
"""... and what it has fallen to at the end besides: nobody knows how much lower it ought to be."""


@dataclass(frozen=True)
class Recovery:
    """One time that training was set going again, for results.json."""

    step: int
    seconds: float
    cause: str
    action: str


def plain_error(data: RayDataModule | PixelDataModule, system: System) -> float:
    """The squared error of the best single colour on training pixels: what a field that shows nothing reaches."""
    truth = system.truth(data.some_pixels().to(system.device))
    return float((truth - truth.mean(0)).square().mean())


class Guard(L.Callback):
    """Watches the loss, the density and the gradients, and acts where they say that nothing more will be learned.

    What it notices: a loss or weights that are no longer finite; a loss that rose, and stays there; a loss that stays at that
    of one plain colour, told apart by whether there is no density, density everywhere, or no gradient (see `Watch`); before
    the first step, a learning rate that the field is known not to stand, which it lowers. What else it does: back to the last
    good weights with a lower rate; or, where there was nothing good yet, a new start with fresh weights, with softplus in
    place of a rectifier that can die, else with a lower rate. Each time is printed and stands in results.json.

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
        self.keep_every = keep_every
        self.watch = Watch(every, patience)
        self.recoveries: list[Recovery] = []
        self.rate = 1.0
        self.began_at = 0.0
        """Progress at the last new start."""
        self.softened = False
        self._given_up = False
        self._finite = True
        """Whether all losses so far were numbers."""
        self._unread: list[Tensor] = []
        """Losses since the last look: reading one makes the host wait for the device."""
        self._start: dict[str, Tensor] = {}
        self._good: dict[str, Tensor] = {}

    # What Lightning calls

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        if stage == "fit" and self.attempts:
            self._start = copied(pl_module)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        with Budget.of(trainer).paused():
            self.watch.plain = plain_error(data_of(trainer), pl_module)
        if self.attempts and self.watch.learning and not self.watch.risen and finite(pl_module.parameters()):
            self._good = copied(pl_module)  # of a run that is resumed
        if isinstance(pl_module, NeRF3D):
            if self.watch.began:
                pl_module.sampler.restart(self.watch.began)
            if self.attempts and trainer.global_step == 0 and trainer.world_size == 1:
                self._slow_down(trainer, pl_module)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: System, batch: Any, batch_idx: int) -> None:
        pl_module.rate = self.rate
        if self.watch.began and self.rate < 1:
            since = trainer.global_step - self.watch.began
            done = (pl_module.progress - self.began_at) / max(1 - self.began_at, 1e-6)
            pl_module.rate *= min(1.0, (since + 1) / WARM) * COOL**done

    def on_after_backward(self, trainer: L.Trainer, pl_module: System) -> None:
        if self.watch.due(trainer.global_step + 1) and not self.watch.learning:
            self.watch.note_gradient(any(p.grad is not None and bool(p.grad.any()) for p in pl_module.parameters()))

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self._given_up or not self.attempts or trainer.world_size > 1:
            return
        step, found = trainer.global_step, None
        self._unread.append(pl_module.stats.mse)
        keep = step % self.keep_every == 0
        if not keep and not self.watch.due(step):
            return
        self._read()
        if not self._finite:
            found = Breakdown("the loss is no longer a finite number", apart=True)
        elif self.watch.due(step):
            opacity = pl_module.stats.opacity
            found = self.watch.look(step, None if opacity is None else float(opacity.mean()))
        if found is None and keep and self.watch.learning and not self.watch.risen:
            if finite(pl_module.parameters()):
                self._good = copied(pl_module)
            else:
                found = Breakdown("weights are no longer finite numbers", apart=True)
        if found is not None:
            self._recover(trainer, pl_module, found)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self._read()

    def _read(self) -> None:
        """Takes in the losses since the last look, all at once."""
        errors = torch.stack(self._unread).tolist() if self._unread else []
        self._unread = []
        for error in errors:
            self._finite = self._finite and math.isfinite(error)
            if self._finite:
                self.watch.note(error)

    def state_dict(self) -> dict[str, Any]:
        self._read()
        return {
            **self.watch.state(),
            "recoveries": [asdict(one) for one in self.recoveries],
            "rate": self.rate,
            "began_at": self.began_at,
            "softened": self.softened,
            "given_up": self._given_up,
            "finite": self._finite,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.watch.load(state_dict)
        self.recoveries = [Recovery(**one) for one in state_dict["recoveries"]]
        for key in ("rate", "began_at", "softened"):
            setattr(self, key, state_dict[key])
        self._given_up = state_dict["given_up"]
        self._finite = state_dict.get("finite", True)  # older checkpoints lack it

    # What it does

    def _recover(self, trainer: L.Trainer, system: System, found: Breakdown) -> None:
        step = trainer.global_step
        self._finite = True
        if len(self.recoveries) >= self.attempts:
            self._given_up = True
            print(f"guard: step {step}: {found.cause}; given up after {self.attempts} attempts", flush=True)
            return
        if self._good:
            system.load_state_dict(self._good)
            self.rate *= LOWER
            action = f"back to the last good weights, with {self.rate:.2g} times the learning rate"
            self.watch.start()
        else:
            action = self._start_again(system, step, found.apart)
            self.watch.start(step)
            self.began_at = system.progress
        forget(trainer)
        self._record(trainer, found.cause, action)

    def _record(self, trainer: L.Trainer, cause: str, action: str) -> None:
        step, seconds = trainer.global_step, round(Budget.of(trainer).seconds, 3)
        self.recoveries.append(Recovery(step, seconds, cause, action))
        print(f"guard: step {step}: {cause}; {action}", flush=True)

    def _slow_down(self, trainer: L.Trainer, system: NeRF3D) -> None:
        """Before the first step, where the rate is one at which the field is known to come apart."""
        optimizer = trainer.optimizers[0]
        asked, fastest = optimizer.param_groups[0]["initial_lr"], system.field.fastest
        if isinstance(optimizer, torch.optim.Adam | torch.optim.AdamW) and asked > fastest:
            self.rate = fastest / asked
            cause = f"a learning rate of {asked:.3g} is more than this field stands ({fastest:.3g})"
            self._record(trainer, cause, f"{self.rate:.2g} times the learning rate")

    def _start_again(self, system: System, step: int, apart: bool) -> str:
        """Fresh weights, and something else besides, as the same again would come to the same end."""
        system.load_state_dict(self._start)
        fresh = copy.deepcopy(
            system.field
        ).cpu()  # the same weights on every device, and none of its random numbers used up
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(step_generator(system.seed, Stream.RESTART, step).initial_seed() & 0xFFFFFFFF))
            started_anew(fresh)
        system.field.load_state_dict(fresh.state_dict())
        system.on_fit_start()  # what a sampler finds out about the scene is part of a start
        if isinstance(system, NeRF3D):
            system.sampler.restart(step)
        rectifiers = [module for module in system.modules() if isinstance(module, Rectifier)]
        if rectifiers and not self.softened and not apart:
            self.softened = True
            action = "started again with softplus in place of the rectifier that makes the density"
        else:
            self.rate *= LOWER if apart else MUCH_LOWER
            action = f"started again with {self.rate:.2g} times the learning rate"
        if self.softened:
            for one in rectifiers:
                one.soften()
        return action


def copied(module: torch.nn.Module) -> dict[str, Tensor]:
    """A copy of all weights and buffers."""
    return {key: value.detach().clone() for key, value in module.state_dict().items()}


def started_anew(module: torch.nn.Module) -> None:
    """Draws weights again, layers first: a field may have a start of its own for them."""
    for part in reversed(list(module.modules())):
        reset = getattr(part, "reset_parameters", None)
        if reset is not None:
            reset()


def finite(parameters: Iterable[torch.nn.Parameter]) -> bool:
    """Whether all weights are numbers; a sum shows any that is not, and all together cost one reading."""
    return bool(torch.stack([parameter.detach().sum() for parameter in parameters]).isfinite().all())


def forget(trainer: L.Trainer) -> None:
    """Empties what optimisers remember of gradients."""
    for optimizer in trainer.optimizers:
        optimizer.state.clear()
        optimizer.zero_grad()
