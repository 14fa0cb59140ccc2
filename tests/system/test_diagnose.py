import functools
import math

import pytest
import torch

from nerf_lightning.dataset import Picture, PictureBatch, PixelDataModule
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.model import FourierField, PictureField, PictureMLP, SirenField
from nerf_lightning.system import NeRF2D, constant, nerf2d
from nerf_lightning.system.nerf2d import dead_relus

SIZE = (20, 20)
ADAM = functools.partial(torch.optim.Adam, lr=0.01)


@pytest.fixture(scope="module")
def view() -> PictureBatch:
    return PixelDataModule(Picture("sunset", "test", builtin_picture(20))).held_out(0)


def diagnosis(field: PictureField, view: PictureBatch) -> str:
    return NeRF2D(field, ADAM, constant).diagnose(view)


def shifted(field: PictureField, layer: int, by: float) -> PictureField:
    """The field with the bias of one of its layers moved."""
    with torch.no_grad():
        [module for module in field.modules() if isinstance(module, torch.nn.Linear)][layer].bias += by
    return field


@pytest.mark.parametrize(("make", "layer"), [(PictureMLP, 2), (FourierField, 1)])
def test_diagnose_dead_relus_are_named(make, layer: int, view):
    field = shifted(make(SIZE, width=16), layer, -1e4)
    told = diagnosis(field, view)
    assert "same colour" in told and "100% of a layer's ReLUs are off" in told and "lower learning rate" in told
    shares = dead_relus(field, view.uv)
    assert len(shares) == 3 and shares[layer] == 1.0 and max(shares[:layer], default=0) < 1


@pytest.mark.parametrize(
    "make", [functools.partial(PictureMLP, width=16), functools.partial(FourierField, width=16), SirenField]
)
def test_diagnose_healthy_field_is_silent(make, view):
    assert diagnosis(make(SIZE), view) == ""


def test_diagnose_saturated_field_names_sigmoid(view):
    told = diagnosis(shifted(PictureMLP(SIZE, width=16), -1, 100.0), view)
    assert "sigmoid" in told and "lower learning rate" in told and "ReLU" not in told


class HalfDead(PictureField):
    """Two ReLUs of four are off everywhere, one is on in the last row alone."""

    def __init__(self):
        super().__init__(SIZE)
        self.relu = torch.nn.ReLU()

    def forward(self, uv: torch.Tensor) -> torch.Tensor:
        self.asked = len(uv)
        y = uv[:, 1:]
        return self.relu(torch.cat([y - 1, -y, y - 0.96, y], dim=1))[:, 1:]


def test_dead_relus_are_off_at_every_place(view, monkeypatch):
    field = HalfDead()
    assert dead_relus(field, view.uv) == [0.5]
    assert dead_relus(field, view.uv[:-20]) == [0.75]
    assert dead_relus(SirenField(SIZE), view.uv) == []
    monkeypatch.setattr(nerf2d, "LOOKED", 25)
    assert dead_relus(field, view.uv)[0] >= 0.5 and field.asked == 25, "some places of a large picture are enough"


class Waves(PictureField):
    """Cosines of so many cycles across the picture."""

    def __init__(self, cycles: int):
        super().__init__(SIZE)
        self.cycles = cycles

    def forward(self, uv: torch.Tensor) -> torch.Tensor:
        return (0.5 + 0.4 * torch.cos(2 * torch.pi * self.cycles * uv[:, :1])).expand(-1, 3)


def waves_seen(cycles: int) -> tuple[NeRF2D, PictureBatch]:
    system = NeRF2D(Waves(cycles), ADAM, constant)
    data = PixelDataModule(Picture("waves", "test", torch.zeros(20, 20, 3, dtype=torch.uint8)))
    empty = data.held_out(0)
    return system, PictureBatch(empty.uv, system.colours(empty.uv), 20, 20)


def test_between_pixels_compares_with_mean_of_neighbours():
    system, view = waves_seen(1)
    # Neighbours of a wave of one cycle are 18 degrees apart: their mean falls short of it by 1 - cos(9 degrees).
    expected = -10 * math.log10((0.4 * (1 - math.cos(math.radians(9)))) ** 2 / 2)
    assert system.between(view) == pytest.approx(expected, abs=0.3)


def test_between_pixels_aliased_frequencies_score_low():
    slow, view = waves_seen(1)
    fast, _ = waves_seen(21)  # at the pixels' middles the same, but for the sign
    assert fast.between(PictureBatch(view.uv, fast.colours(view.uv), 20, 20)) < 15 < slow.between(view)


@pytest.mark.parametrize("size", [(1, 20), (20, 1), (1, 1)])
def test_between_pixels_single_row_is_none(size: tuple[int, int], view):
    height, width = size
    line = PictureBatch(view.uv[: height * width], view.rgb[: height * width], height, width)
    assert NeRF2D(Waves(1), ADAM, constant).between(line) is None
