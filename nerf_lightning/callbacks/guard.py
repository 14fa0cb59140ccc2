"""Guard: notices when training has broken down, says why, and restarts it."""

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
from nerf_lightning.model import SoftenableReLU
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.options import AtLeast, Count
from nerf_lightning.utils.seeding import Stream, step_generator

LOWER, MUCH_LOWER = 0.3, 0.2
"""Factors on the learning rate when it is the cause: after something was learned, and when nothing was."""
WARM = 100
"""Steps of warm-up after a restart because of the rate ..."""
COOL = 0.1
"""... and the extra factor it decays to by the end, as nobody knows how much lower it should be."""


@dataclass(frozen=True)
class Recovery:
    """One restart of training, for results.json."""

    step: int
    seconds: float
    cause: str
    action: str


def plain_error(data: RayDataModule | PixelDataModule, system: System) -> float:
    """Mean squared error of the best single colour on training pixels: what a field that shows nothing reaches."""
    truth = system.truth(data.some_pixels().to(system.device))
    return float((truth - truth.mean(0)).square().mean())


class Guard(L.Callback):
    """Watches the loss, the density and the gradients, and acts when nothing more will be learned.

    It notices a loss or weights that are no longer finite; a loss that rose and stays high; a loss stuck at that of one plain
    colour, because there is no density, density everywhere, or no gradient (see `Watch`). It then goes back to the last good
    weights with a lower learning rate. If there are none yet, it starts again with fresh weights, and with softplus in place of
    a ReLU that can die, or else a lower rate. Before the first step it lowers a rate that is known to be too high for the
    field. Each action is printed and listed in results.json.

    Weights and gradients are checked only every few steps, and gradients only until the field has begun to learn. With several
    processes it does nothing.

    Args:
        attempts: most times that it acts; 0 turns it off.
        every: steps between looks.
        patience: steps within which the loss must fall below that of a plain colour, or at least fall.
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
        """Progress at the last restart."""
        self.softened = False
        self._given_up = False
        self._finite = True
        """Whether all losses so far were finite."""
        self._unread: list[Tensor] = []
        """Losses since the last look: reading one means waiting for the device."""
        self._start: dict[str, Tensor] = {}
        self._good: dict[str, Tensor] = {}

    # Lightning's hooks

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        if stage == "fit" and self.attempts:
            self._start = copied(pl_module)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        with Budget.of(trainer).paused():
            self.watch.plain = plain_error(data_of(trainer), pl_module)
        if self.attempts and self.watch.learning and not self.watch.risen and finite(pl_module.parameters()):
            self._good = copied(pl_module)  # of a resumed run
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
        """Reads the losses since the last look, all at once."""
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
        self.rate, self.began_at, self.softened = (state_dict[key] for key in ("rate", "began_at", "softened"))
        self._given_up, self._finite = state_dict["given_up"], state_dict["finite"]

    # Actions

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
        """Before the first step: lowers a rate that is known to be too high for the field."""
        optimizer = trainer.optimizers[0]
        asked, fastest = optimizer.param_groups[0]["initial_lr"], system.field.fastest
        if isinstance(optimizer, torch.optim.Adam | torch.optim.AdamW) and asked > fastest:
            self.rate = fastest / asked
            cause = f"a learning rate of {asked:.3g} is too high for this field, which trains at up to {fastest:.3g}"
            self._record(trainer, cause, f"{self.rate:.2g} times the learning rate")

    def _start_again(self, system: System, step: int, apart: bool) -> str:
        """Fresh weights, and one other change: the same again would fail again."""
        system.load_state_dict(self._start)
        fresh = copy.deepcopy(
            system.field
        ).cpu()  # the same weights on every device, and none of its random numbers used up
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(step_generator(system.seed, Stream.RESTART, step).initial_seed() & 0xFFFFFFFF))
            started_anew(fresh)
        system.field.load_state_dict(fresh.state_dict())
        system.on_fit_start()  # the sampler learns about the scene at the start
        if isinstance(system, NeRF3D):
            system.sampler.restart(step)
        relus = [module for module in system.modules() if isinstance(module, SoftenableReLU)]
        if relus and not self.softened and not apart:
            self.softened = True
            action = "started again with softplus in place of the ReLU that makes the density"
        else:
            self.rate *= LOWER if apart else MUCH_LOWER
            action = f"started again with {self.rate:.2g} times the learning rate"
        if self.softened:
            for one in relus:
                one.soften()
        return action


def copied(module: torch.nn.Module) -> dict[str, Tensor]:
    """A copy of all weights and buffers."""
    return {key: value.detach().clone() for key, value in module.state_dict().items()}


def started_anew(module: torch.nn.Module) -> None:
    """Draws weights again, layers first: a field may initialise some of them itself."""
    for part in reversed(list(module.modules())):
        reset = getattr(part, "reset_parameters", None)
        if reset is not None:
            reset()


def finite(parameters: Iterable[torch.nn.Parameter]) -> bool:
    """Whether all weights are finite. A sum shows any that is not, so one value is read for all."""
    return bool(torch.stack([parameter.detach().sum() for parameter in parameters]).isfinite().all())


def forget(trainer: L.Trainer) -> None:
    """Clears the optimisers' state."""
    for optimizer in trainer.optimizers:
        optimizer.state.clear()
        optimizer.zero_grad()
