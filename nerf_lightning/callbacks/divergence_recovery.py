"""Divergence recovery: detects when training has broken down, and restarts it."""

import copy
import math
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import lightning as L
import torch
from torch import Tensor

from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.loss_monitor import LossHistory, LossMonitor, TrainingFailure
from nerf_lightning.callbacks.trainer_access import get_datamodule
from nerf_lightning.model import SoftenableReLU
from nerf_lightning.system import System
from nerf_lightning.utils.option_checks import Count, Ge
from nerf_lightning.utils.seeding import Stream, step_generator

LR_CUT_AFTER_LEARNING, LR_CUT = 0.3, 0.2
"""Learning-rate factors of a restart: if the field had learned or diverged, and if it never learned."""
RESTART_WARMUP_STEPS = 100
"""Warm-up steps after a restart with a lower learning rate ..."""
RESTART_LR_DECAY = 0.1
"""... and the extra factor it decays to by the end, as the right learning rate is unknown."""


@dataclass(frozen=True)
class Recovery:
    """One restart of training, for results.json."""

    step: int
    seconds: float
    cause: str
    action: str


class DivergenceRecovery(L.Callback):
    """Detects diverged or stalled training and restarts it with one change.

    Detects loss or weights that are not finite; a loss that rose and stays high; a loss stuck at that of a constant color,
    because there is no density, density everywhere, or no gradient (see `LossMonitor`). It then restores the last good weights
    with a lower learning rate. If there are none yet, it restarts with fresh weights, and with softplus in place of a ReLU that
    can die, or else a lower learning rate. Before the first step it caps the learning rate at the field's known maximum. Each
    action is printed and listed in results.json.

    Weights and gradients are checked only every few steps, and gradients only until the field has begun to learn. Inactive with
    several processes.

    Args:
        max_restarts: most restarts; 0 turns it off.
        every: steps between checks.
        patience: steps within which the loss must fall below that of a constant color, or at least fall.
        snapshot_every: steps between copies of good weights.
    """

    def __init__(
        self,
        max_restarts: Annotated[int, Ge(0)] = 3,
        every: Count = 20,
        patience: Count = 100,
        snapshot_every: Count = 250,
    ):
        self.max_restarts = max_restarts
        self.snapshot_every = snapshot_every
        self.monitor = LossMonitor(every, patience)
        self.recoveries: list[Recovery] = []
        self.lr_factor = 1.0
        self.restart_progress = 0.0
        """Progress at the last restart."""
        self.uses_softplus = False
        self._is_exhausted = False
        self._pending_losses: list[Tensor] = []
        """Losses since the last check: reading one synchronizes with the device."""
        self._initial_state: dict[str, Tensor] = {}
        self._good_state: dict[str, Tensor] = {}

    # Lightning's hooks

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        if stage == "fit" and self.max_restarts:
            self._initial_state = copy_state(pl_module)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        with Budget.find(trainer).pause():
            batch = get_datamodule(trainer).make_baseline_batch().to(pl_module.device)
            truth = pl_module.compute_target_rgb(batch, is_training=True)
            self.monitor.constant_color_loss = float((truth - truth.mean(0)).square().mean())
        if self.max_restarts and self.monitor.is_healthy and is_finite(pl_module):
            self._good_state = copy_state(pl_module)  # of a resumed run
        if self.monitor.history.start_step:
            pl_module.set_first_step(self.monitor.history.start_step)
        if self.max_restarts and trainer.global_step == 0 and trainer.world_size == 1:
            self._cap_learning_rate(trainer, pl_module)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        scale = self.lr_factor
        start_step = self.monitor.history.start_step
        if start_step and self.lr_factor < 1:
            warmup = min(1.0, (trainer.global_step - start_step + 1) / RESTART_WARMUP_STEPS)
            decay_progress = (pl_module.state.progress - self.restart_progress) / max(1 - self.restart_progress, 1e-6)
            scale *= warmup * RESTART_LR_DECAY**decay_progress
        pl_module.state.set_lr_scale(scale)

    def on_after_backward(self, trainer: L.Trainer, pl_module: System) -> None:
        if self.monitor.is_due(trainer.global_step + 1) and not self.monitor.has_learned:
            has_gradient = any(p.grad is not None and bool(p.grad.any()) for p in pl_module.parameters())
            self.monitor.add_gradient(has_gradient)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        if self._is_exhausted or not self.max_restarts or trainer.world_size > 1:
            return
        step = trainer.global_step
        self._pending_losses.append(pl_module.stats.mse)
        is_snapshot_step = step % self.snapshot_every == 0
        if not is_snapshot_step and not self.monitor.is_due(step):
            return
        self._read_losses()
        loss, failure = self.monitor.history.ema_loss, None
        if loss is not None and not math.isfinite(loss):
            failure = TrainingFailure("the loss is no longer a finite number", diverged=True)
        elif self.monitor.is_due(step):
            opacity = pl_module.stats.opacity
            failure = self.monitor.check(step, None if opacity is None else float(opacity.mean()))
        if failure is None and is_snapshot_step and self.monitor.is_healthy:
            if is_finite(pl_module):
                self._good_state = copy_state(pl_module)
            else:
                failure = TrainingFailure("weights are no longer finite numbers", diverged=True)
        if failure is not None:
            self._recover(trainer, pl_module, failure)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self._read_losses()

    def _read_losses(self) -> None:
        """Reads the pending losses with one synchronization."""
        losses = torch.stack(self._pending_losses).tolist() if self._pending_losses else []
        self._pending_losses = []
        for loss in losses:
            self.monitor.add_loss(loss)

    def state_dict(self) -> dict[str, Any]:
        self._read_losses()
        return {
            "history": asdict(self.monitor.history),
            "recoveries": [asdict(recovery) for recovery in self.recoveries],
            "rate": self.lr_factor,
            "restart_progress": self.restart_progress,
            "softened": self.uses_softplus,
            "given_up": self._is_exhausted,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.monitor.history = LossHistory(**state_dict["history"])
        self.recoveries = [Recovery(**fields) for fields in state_dict["recoveries"]]
        self.lr_factor, self.restart_progress = state_dict["rate"], state_dict["restart_progress"]
        self.uses_softplus, self._is_exhausted = state_dict["softened"], state_dict["given_up"]

    # Actions

    def _recover(self, trainer: L.Trainer, system: System, failure: TrainingFailure) -> None:
        step = trainer.global_step
        if len(self.recoveries) >= self.max_restarts:
            self._is_exhausted = True
            print(f"recovery: step {step}: {failure.cause}; giving up after {self.max_restarts} restarts", flush=True)
            return
        if self._good_state:
            system.load_state_dict(self._good_state)
            self.lr_factor *= LR_CUT_AFTER_LEARNING
            action = f"back to the last good weights, with {self.lr_factor:.2g} times the learning rate"
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
        step, seconds = trainer.global_step, round(Budget.find(trainer).seconds, 3)
        self.recoveries.append(Recovery(step, seconds, cause, action))
        print(f"recovery: step {step}: {cause}; {action}", flush=True)

    def _cap_learning_rate(self, trainer: L.Trainer, system: System) -> None:
        """Caps the learning rate at the field's known maximum, before the first step."""
        optimizer = trainer.optimizers[0]
        lr, max_lr = optimizer.param_groups[0]["initial_lr"], system.field.max_lr
        if isinstance(optimizer, torch.optim.Adam | torch.optim.AdamW) and lr > max_lr:
            self.lr_factor = max_lr / lr
            cause = f"a learning rate of {lr:.3g} is too high for this field, which trains at up to {max_lr:.3g}"
            self._record(trainer, cause, f"{self.lr_factor:.2g} times the learning rate")

    def _restart(self, system: System, step: int, diverged: bool) -> str:
        """Reinitializes the weights and changes one thing, so that the failure is not repeated."""
        system.load_state_dict(self._initial_state)
        # On the CPU: the same weights on every device, whose random state does not change.
        fresh = copy.deepcopy(system.field).cpu()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(step_generator(system.seed, Stream.RESTART, step).initial_seed() & 0xFFFFFFFF))
            for module in reversed(list(fresh.modules())):  # layers first: a field may initialize some of them itself
                if reset := getattr(module, "reset_parameters", None):
                    reset()
        system.field.load_state_dict(fresh.state_dict())
        system.restart(step)
        relus = [module for module in system.modules() if isinstance(module, SoftenableReLU)]
        if relus and not self.uses_softplus and not diverged:
            self.uses_softplus = True
            action = "started again with softplus in place of the ReLU that makes the density"
        else:
            self.lr_factor *= LR_CUT_AFTER_LEARNING if diverged else LR_CUT
            action = f"started again with {self.lr_factor:.2g} times the learning rate"
        if self.uses_softplus:
            for relu in relus:
                relu.soften()
        return action


def copy_state(module: torch.nn.Module) -> dict[str, Tensor]:
    """Copies all weights and buffers."""
    return {key: value.detach().clone() for key, value in module.state_dict().items()}


def is_finite(module: torch.nn.Module) -> bool:
    """Whether all weights are finite, by their sums, so that one value is read for all."""
    return bool(torch.stack([parameter.detach().sum() for parameter in module.parameters()]).isfinite().all())
