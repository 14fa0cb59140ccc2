import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import lightning as L
import pytest
import torch

from nerf_lightning.dataset import Picture, PixelDataModule
from nerf_lightning.dataset.pixel_subset import ALL_PIXELS, PixelSubset
from nerf_lightning.model import PictureField
from nerf_lightning.system import NeRF2D, StepStats, ViewResult, constant


class Clock:
    """Fake time.perf_counter that only `wait` advances."""

    now = 100.0

    def __call__(self) -> float:
        return self.now

    def wait(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time, "perf_counter", clock)
    return clock


class GrayField(PictureField):
    def __init__(self):
        super().__init__((16, 12))
        self.gray = torch.nn.Parameter(torch.tensor(0.5))

    def forward(self, uv: torch.Tensor) -> torch.Tensor:
        return self.gray.expand(len(uv), 3)


class ScriptedSystem(NeRF2D):
    """Fake system with given PSNR values, which records the views it evaluates."""

    def __init__(self):
        super().__init__(GrayField(), functools.partial(torch.optim.SGD, lr=0.1), constant)
        self.psnrs = iter(range(10, 1000))
        self.evaluated: list[Any] = []
        mse = torch.tensor(0.01, dtype=torch.float64)
        self.stats = StepStats(mse, 30, 90, losses={"photometric": mse})

    def evaluate(self, view: Any) -> ViewResult:
        self.evaluated.append(view)
        time.perf_counter.wait(50)  # slow, which must not count
        picture = torch.rand(12, 16, 3)
        return ViewResult(picture, picture, float(next(self.psnrs)), 50.0)


@pytest.fixture
def system() -> ScriptedSystem:
    return ScriptedSystem()


class Data(PixelDataModule):
    num_held_out_views = 10

    def __init__(self, scene: Picture):
        super().__init__(scene)
        self.subsets: list[PixelSubset] = []
        """Subset requested of each view."""

    def get_held_out_view(self, view: int, subset: PixelSubset = ALL_PIXELS) -> int:
        self.subsets.append(subset)
        return view

    def count_held_out_pixels(self, view: int) -> int:
        return 12 * 16


@pytest.fixture
def trainer_with(tmp_path: Path) -> Callable[..., L.Trainer]:
    """A fake trainer with the given callbacks."""

    def make(*callbacks: L.Callback) -> L.Trainer:
        trainer = Mock(spec=L.Trainer)
        trainer.callbacks = list(callbacks)
        trainer.datamodule = Data(Picture("gray", "test", torch.zeros(4, 4, 3, dtype=torch.uint8)))
        trainer.global_step, trainer.should_stop = 0, False
        trainer.default_root_dir = str(tmp_path)
        trainer.logger = Mock()
        trainer.optimizers = [Mock(param_groups=[{"name": "field", "lr": 0.1}])]
        trainer.world_size, trainer.is_global_zero = 1, True
        return trainer

    return make
