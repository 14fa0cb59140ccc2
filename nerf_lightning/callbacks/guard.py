"""Guard: notices when training has broken down, says why, and restarts it."""

import copy
import math
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import lightning as L
import torch
from torch import Tensor

from nerf_lightning.callbacks.attached import data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.loss_monitor import LossHistory, LossMonitor, TrainingFailure
from nerf_lightning.model import SoftenableReLU
from nerf_lightning.system import System
from nerf_lightning.utils.options import AtLeast, Count
from nerf_lightning.utils.seeding import Stream, step_generator

LR_CUT_AFTER_LEARNING, LR_CUT = 0.3, 0.2
"""Factors on the learning rate when it is the cause: after something was learned, and when nothing was."""
RESTART_WARMUP_STEPS = 100
"""Steps of warm-up after a restart because of the rate ..."""
RESTART_LR_DECAY = 0.1
"""... and the extra factor it decays to by the end, as nobody knows how much lower it should be."""


@dataclass(frozen=True)
class Recovery:
    """One restart of training, for results.json."""

    step: int
    seconds: float
    cause: str
    action: str


class Guard(L.Callback):
    """Watches the loss, the density and the gradients, and acts when nothing more will be learned.

    It notices a loss or weights that are no longer finite; a loss that rose and stays high; a loss stuck at that of one plain
    colour, because there is no density, density everywhere, or no gradient (see `LossMonitor`). It then goes back to the last
    good weights with a lower learning rate. If there are none yet, it starts again with fresh weights, and with softplus in
    place of a ReLU that can die, or else a lower rate. Before the first step it lowers a rate that is known to be too high
    for the field. Each action is printed and listed in results.json.

    Weights and gradients are checked only every few steps, and gradients only until the field has begun to learn. With several
    processes it does nothing.

    Args:
        attempts: most times that it acts; 0 turns it off.
        every: steps between checks.
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
        self.monitor = LossMonitor(every, patience)
        self.recoveries: list[Recovery] = []
        self.rate = 1.0
        self.restart_progress = 0.0
        """Progress at the last restart."""
        self.softened = False
        self._given_up = False
        self._pending_losses: list[Tensor] = []
        """Since the last check: reading one means waiting for the device."""
        self._initial: dict[str, Tensor] = {}
        self._good: dict[str, Tensor] = {}

    # Lightning's hooks

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        if stage == "fit" and self.attempts:
            self._initial = copy_state(pl_module)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        with Budget.of(trainer).paused():
            truth = pl_module.truth(data_of(trainer).some_pixels().to(pl_module.device))
            self.monitor.plain_loss = float((truth - truth.mean(0)).square().mean())
        if self.attempts and self.monitor.is_healthy and all_finite(pl_module):
            self._good = copy_state(pl_module)  # of a resumed run
        if self.monitor.history.start_step:
            pl_module.set_first_step(self.monitor.history.start_step)
        if self.attempts and trainer.global_step == 0 and trainer.world_size == 1:
            self._cap_learning_rate(trainer, pl_module)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        scale = self.rate
        start_step = self.monitor.history.start_step
        if start_step and self.rate < 1:
            warmup = min(1.0, (trainer.global_step - start_step + 1) / RESTART_WARMUP_STEPS)
            done = (pl_module.state.progress - self.restart_progress) / max(1 - self.restart_progress, 1e-6)
            scale *= warmup * RESTART_LR_DECAY**done
        pl_module.state.scale_lr(scale)

    def on_after_backward(self, trainer: L.Trainer, pl_module: System) -> None:
        if self.monitor.is_due(trainer.global_step + 1) and not self.monitor.has_learned:
            alive = any(p.grad is not None and bool(p.grad.any()) for p in pl_module.parameters())
            self.monitor.add_gradient(alive)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        if self._given_up or not self.attempts or trainer.world_size > 1:
            return
        step = trainer.global_step
        self._pending_losses.append(pl_module.stats.mse)
        keep = step % self.keep_every == 0
        if not keep and not self.monitor.is_due(step):
            return
        self._read_losses()
        loss, failure = self.monitor.history.ema_loss, None
        if loss is not None and not math.isfinite(loss):
            failure = TrainingFailure("the loss is no longer a finite number", diverged=True)
        elif self.monitor.is_due(step):
            opacity = pl_module.stats.opacity
            failure = self.monitor.check(step, None if opacity is None else float(opacity.mean()))
        if failure is None and keep and self.monitor.is_healthy:
            if all_finite(pl_module):
                self._good = copy_state(pl_module)
            else:
                failure = TrainingFailure("weights are no longer finite numbers", diverged=True)
        if failure is not None:
            self._recover(trainer, pl_module, failure)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self._read_losses()

    def _read_losses(self) -> None:
        """Reads the losses since the last check, all at once."""
        losses = torch.stack(self._pending_losses).tolist() if self._pending_losses else []
        self._pending_losses = []
        for loss in losses:
            self.monitor.add_loss(loss)

    def state_dict(self) -> dict[str, Any]:
        self._read_losses()
        return {
            "history": asdict(self.monitor.history),
            "recoveries": [asdict(one) for one in self.recoveries],
            "rate": self.rate,
            "restart_progress": self.restart_progress,
            "softened": self.softened,
            "given_up": self._given_up,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.monitor.history = LossHistory(**state_dict["history"])
        self.recoveries = [Recovery(**one) for one in state_dict["recoveries"]]
        self.rate, self.restart_progress = state_dict["rate"], state_dict["restart_progress"]
        self.softened, self._given_up = state_dict["softened"], state_dict["given_up"]

    # Actions

    def _recover(self, trainer: L.Trainer, system: System, failure: TrainingFailure) -> None:
        step = trainer.global_step
        if len(self.recoveries) >= self.attempts:
            self._given_up = True
            print(f"guard: step {step}: {failure.cause}; given up after {self.attempts} attempts", flush=True)
            return
        if self._good:
            system.load_state_dict(self._good)
            self.rate *= LR_CUT_AFTER_LEARNING
            action = f"back to the last good weights, with {self.rate:.2g} times the learning rate"
            self.monitor.reset()
        else:
            action = self._restart(system, step, failure.diverged)
            self.monitor.reset(step)
            self.restart_progress = system.state.progress
        for optimizer in trainer.optimizers:
            optimizer.state.clear()
            optimizer.zero_grad()
        self._record(trainer, failure.cause, action)

    def _record(self, trainer: L.Trainer, cause: str, action: str) -> None:
        step, seconds = trainer.global_step, round(Budget.of(trainer).seconds, 3)
        self.recoveries.append(Recovery(step, seconds, cause, action))
        print(f"guard: step {step}: {cause}; {action}", flush=True)

    def _cap_learning_rate(self, trainer: L.Trainer, system: System) -> None:
        """Before the first step: lowers a rate that is known to be too high for the field."""
        optimizer = trainer.optimizers[0]
        asked, max_lr = optimizer.param_groups[0]["initial_lr"], system.field.max_lr
        if isinstance(optimizer, torch.optim.Adam | torch.optim.AdamW) and asked > max_lr:
            self.rate = max_lr / asked
            cause = f"a learning rate of {asked:.3g} is too high for this field, which trains at up to {max_lr:.3g}"
            self._record(trainer, cause, f"{self.rate:.2g} times the learning rate")

    def _restart(self, system: System, step: int, diverged: bool) -> str:
        """Fresh weights, and one other change: the same again would fail again."""
        system.load_state_dict(self._initial)
        # On the CPU: the same weights on every device, and none of its random numbers used up.
        fresh = copy.deepcopy(system.field).cpu()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(step_generator(system.seed, Stream.RESTART, step).initial_seed() & 0xFFFFFFFF))
            for module in reversed(list(fresh.modules())):  # layers first: a field may initialise some of them itself
                if reset := getattr(module, "reset_parameters", None):
                    reset()
        system.field.load_state_dict(fresh.state_dict())
        system.restart(step)
        relus = [module for module in system.modules() if isinstance(module, SoftenableReLU)]
        if relus and not self.softened and not diverged:
            self.softened = True
            action = "started again with softplus in place of the ReLU that makes the density"
        else:
            self.rate *= LR_CUT_AFTER_LEARNING if diverged else LR_CUT
            action = f"started again with {self.rate:.2g} times the learning rate"
        if self.softened:
            for relu in relus:
                relu.soften()
        return action


def copy_state(module: torch.nn.Module) -> dict[str, Tensor]:
    """A copy of all weights and buffers."""
    return {key: value.detach().clone() for key, value in module.state_dict().items()}


def all_finite(module: torch.nn.Module) -> bool:
    """Whether all weights are finite. A sum shows any that is not, so one value is read for all."""
    return bool(torch.stack([parameter.detach().sum() for parameter in module.parameters()]).isfinite().all())
