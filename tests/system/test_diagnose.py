import functools
import math

import pytest
import torch

from nerf_lightning.dataset import Picture, PictureBatch, PixelDataModule
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.model import FourierField, PictureField, PictureMLP, SirenField
from nerf_lightning.system import NeRF2D, constant
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


class Wave(PictureField):
    """A cosine of one cycle across the picture."""

    def forward(self, uv: torch.Tensor) -> torch.Tensor:
        return (0.5 + 0.4 * torch.cos(2 * torch.pi * uv[:, :1])).expand(-1, 3)


def test_between_pixels_compares_with_mean_of_neighbours(view):
    system = NeRF2D(Wave(SIZE), ADAM, constant)
    # Neighbours of the wave are 18 degrees apart: their mean falls short of it by 1 - cos(9 degrees).
    expected = -10 * math.log10((0.4 * (1 - math.cos(math.radians(9)))) ** 2 / 2)
    found = system.between(PictureBatch(view.uv, system.colours(view.uv), 20, 20))
    assert found == pytest.approx(expected, abs=0.3)
