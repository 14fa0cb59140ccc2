"""Divergence recovery: what it detects, what it does, and that it leaves healthy training alone."""

import functools
import json
import math
from pathlib import Path

import lightning as L
import pytest
import torch

from nerf_lightning.callbacks import Budget, DivergenceRecovery
from nerf_lightning.callbacks.divergence_recovery import LR_CUT, LR_CUT_AFTER_LEARNING
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import Picture, PixelDataModule, save_npz
from nerf_lightning.model import PictureField, SirenField
from nerf_lightning.runs.folder import load_run
from nerf_lightning.stability.conditions import METHODS
from nerf_lightning.synthetic.objects import MARBLE, make_object_scene
from nerf_lightning.system import NeRF2D, StepStats, constant
from nerf_lightning.training.train import train
from nerf_lightning.utils.libraries import silence_lightning


class Blob(PictureField):
    """A free color per pixel: learns quickly at any learning rate below one."""

    def __init__(self):
        super().__init__((8, 8))
        self.colors = torch.nn.Parameter(torch.full((64, 3), 0.5))

    def forward(self, uv: torch.Tensor) -> torch.Tensor:
        column, row = (uv * 8).long().unbind(1)
        return self.colors[row * 8 + column]


def stripes() -> Picture:
    image = torch.zeros(8, 8, 3, dtype=torch.uint8)
    image[::2] = 255
    return Picture("stripes", "test", image)


class BrokenSystem(NeRF2D):
    """A system that breaks at a step in a given way."""

    def __init__(self, failure: str, failure_step: int, rate: float = 20.0, field: PictureField | None = None):
        super().__init__(field or Blob(), functools.partial(torch.optim.SGD, lr=rate), constant)
        self.failure, self.failure_step, self.has_failed = failure, failure_step, False

    def training_step(self, batch, batch_idx: int) -> torch.Tensor:
        loss = super().training_step(batch, batch_idx)
        if self.has_failed or self.global_step < self.failure_step:
            return loss
        match self.failure:
            case "nan loss":
                self.has_failed = True
                self.stats = StepStats(torch.tensor(math.nan), 1, 1)
                return loss * math.nan
            case "nan weight":
                self.has_failed = True
                with torch.no_grad():
                    self.field.colors[:, 0] = math.nan  # the step's own gradient is fine
            case "rise" if self.state.lr_scale == 1:
                with torch.no_grad():
                    self.field.colors.uniform_()
            case "spike":
                self.has_failed = True
                with torch.no_grad():
                    self.field.colors.copy_(1 - self.field.colors)
            case "rise a little" if self.state.lr_scale == 1:
                self.set_error(0.4 if self.global_step < 200 else 0.5)
            case "hover" if self.state.lr_scale == 1:  # two steps down, one up
                self.set_error(1.3 - 0.0004 * self.global_step + 0.1 * (self.global_step // 10 % 3 == 2))
            case "no gradient":
                return loss * 0 + (self.field.colors * 0).sum()
        return loss

    @torch.no_grad()
    def set_error(self, error: float) -> None:
        """Sets the field to the stripes with a given fraction of their mean color's error."""
        truth = torch.zeros(8, 8, 3)
        truth[::2] = 1
        self.field.colors.copy_((0.5 + (1 - error**0.5) * (truth - 0.5)).view(64, 3))


def run(system: NeRF2D, recovery: DivergenceRecovery, folder: Path, steps=250, image: Picture | None = None) -> float:
    """Trains and returns the last mean squared error over the picture."""
    data = PixelDataModule(image or stripes(), 64)
    trainer = L.Trainer(
        accelerator="cpu", max_epochs=-1, logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, limit_val_batches=0, default_root_dir=folder, callbacks=[Budget(steps), recovery],
    )  # fmt: skip
    trainer.fit(system, data)
    view = data.get_held_out_view(0)
    return float((system.query_rgb(view.uv) - view.rgb).square().mean())


@pytest.fixture(autouse=True)
def silence_lightning_hints() -> None:
    silence_lightning()


@pytest.mark.parametrize("failure", ["not at all", "spike"])
def test_recovery_healthy_training_does_nothing(failure: str, tmp_path: Path):
    recovery = DivergenceRecovery(every=10)
    assert run(BrokenSystem(failure, 80), recovery, tmp_path) < 1e-3
    assert recovery.recoveries == [] and recovery.lr_factor == 1.0


@pytest.mark.parametrize(
    ("failure", "words"),
    [("nan loss", "no longer a finite number"), ("nan weight", "no longer"), ("rise", "times its lowest")],
)
def test_recovery_broken_step_restores_last_good_weights(
    failure: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    recovery = DivergenceRecovery(every=10, snapshot_every=50)
    assert run(BrokenSystem(failure, 80), recovery, tmp_path) < 1e-3
    (restart,) = recovery.recoveries
    assert words in restart.cause and "last good weights" in restart.action and 80 < restart.step < 180
    assert recovery.lr_factor == pytest.approx(LR_CUT_AFTER_LEARNING)
    assert f"recovery: step {restart.step}" in capsys.readouterr().out, "never silently"


@pytest.mark.parametrize(
    ("failure", "words", "action"),
    [
        ("rise a little", "times that of a constant color, and has stayed above that since", "last good weights"),
        ("hover", "times that of a constant color", "started again with 0.2 times"),
    ],
)
def test_recovery_stalled_training_restarts(failure: str, words: str, action: str, tmp_path: Path):
    recovery = DivergenceRecovery(every=10, patience=60, snapshot_every=50)
    assert run(BrokenSystem(failure, 0), recovery, tmp_path, 600) < 1e-2
    (restart,) = recovery.recoveries
    assert words in restart.cause and action in restart.action


def test_recovery_restart_reinitializes_field(tmp_path: Path):
    field = SirenField((8, 8), width=32, depth=2)
    before = field.hidden[1].weight.detach().clone()
    recovery = DivergenceRecovery(every=10)
    run(BrokenSystem("nan loss", 5, rate=1e-9, field=field), recovery, tmp_path, 20)
    (restart,) = recovery.recoveries
    assert "started again" in restart.action
    after = field.hidden[1].weight.detach()
    bound = math.sqrt(6 / 32) / field.HIDDEN_FREQUENCY
    assert not torch.equal(before, after) and bound / 2 < float(after.abs().max()) <= bound * (1 + 1e-4)


def test_recovery_after_max_restarts_gives_up(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    recovery = DivergenceRecovery(max_restarts=2, every=10, patience=50)
    run(BrokenSystem("no gradient", 0), recovery, tmp_path)
    assert len(recovery.recoveries) == 2 and all("no gradient" in restart.cause for restart in recovery.recoveries)
    assert recovery.lr_factor == pytest.approx(LR_CUT**2)
    assert "giving up after 2 restarts" in capsys.readouterr().out


def test_recovery_constant_image_is_no_failure(tmp_path: Path):
    recovery = DivergenceRecovery(every=10, patience=30)
    plain = Picture("plain", "test", torch.full((8, 8, 3), 90, dtype=torch.uint8))
    assert run(BrokenSystem("not at all", 0), recovery, tmp_path, image=plain) < 1e-3
    assert recovery.recoveries == []


def test_recovery_dead_relu_becomes_softplus(tmp_path: Path):
    """The one of seeds 0 to 7 that dies: zero density everywhere, and no gradient."""
    save_npz(make_object_scene(MARBLE, (1.0, 1.0, 1.0)), tmp_path / "scene.npz")
    given = ["dataset=photos", f"dataset.path={tmp_path}/scene.npz", *METHODS["relu mlp"].options, "seed=7"]
    train(compose_config([*given, "threads=1", "budget.steps=100", "callbacks.orbit.frames=0"], tmp_path))
    (restart,) = json.loads((tmp_path / "results.json").read_text())["recoveries"]
    assert "no density anywhere" in restart["cause"] and "softplus" in restart["action"] and restart["step"] <= 80
    activation = load_run(tmp_path).system.field.activation
    assert activation(torch.tensor([-1.0])) > 0, "a ReLU would give zero"


def test_recovery_resumed_run_restores_resumed_weights(tmp_path: Path):
    before = DivergenceRecovery(every=10)
    run(BrokenSystem("not at all", 0), before, tmp_path, 60)
    recovery = DivergenceRecovery(every=10)
    recovery.load_state_dict(before.state_dict())
    run(BrokenSystem("nan loss", 5), recovery, tmp_path, 60)
    (restart,) = recovery.recoveries
    assert restart.step == 10 and "last good weights" in restart.action


@pytest.mark.parametrize(("optimizer", "lowered"), [(torch.optim.Adam, True), (torch.optim.SGD, False)])
def test_recovery_high_lr_is_capped_for_adam_only(optimizer: type, lowered: bool, tmp_path: Path):
    save_npz(make_object_scene(MARBLE), tmp_path / "scene.npz")
    given = ["dataset=photos", f"dataset.path={tmp_path}/scene.npz", *METHODS["relu mlp"].options, "budget.steps=2"]
    cfg = compose_config([*given, "optimizer.lr=0.5", "callbacks.orbit=null", "threads=1"], tmp_path)
    cfg.optimizer = {"_target_": f"torch.optim.{optimizer.__name__}", "_partial_": True, "lr": 0.5}
    train(cfg)
    recoveries = json.loads((tmp_path / "results.json").read_text())["recoveries"]
    assert [(restart["step"], "0.1 times the learning rate" in restart["action"]) for restart in recoveries] == [
        (0, True)
    ] * lowered
