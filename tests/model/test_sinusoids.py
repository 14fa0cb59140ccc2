"""Fields of random sinusoids and of sines: their frequencies, first weights, and what a checkpoint keeps."""

import math

import pytest
import torch

from nerf_lightning.model import FourierField, SirenField
from tests.model.test_picture_fields import inputs_of


@pytest.mark.parametrize("size", [(64, 32), (32, 64)])
def test_fourier_field_cycles_are_of_longer_side(size: tuple[int, int]):
    field, uv = FourierField(size, features=5, width=8), torch.rand(20, 2)
    lengths = (uv - 0.5) * torch.tensor(size) / 64
    angles = torch.tensor(
        [[2 * math.pi * float(place @ field.cycles[:, k]) for k in range(5)] for place in lengths.unbind()]
    )
    torch.testing.assert_close(inputs_of(field, uv), torch.cat([angles.sin(), angles.cos()], dim=1), atol=1e-4, rtol=0)


def test_fourier_field_checkpoint_keeps_frequencies():
    field, other = (FourierField((20, 10), features=8, width=8) for _ in range(2))
    assert not torch.equal(field.cycles, other.cycles)
    assert "cycles" not in dict(field.named_parameters()), "they are not trained"
    other.load_state_dict(field.state_dict())
    uv = torch.rand(9, 2)
    assert torch.equal(field(uv), other(uv))


def test_siren_first_frequency_is_of_paper():
    assert SirenField((256, 256), width=8, reach=0.075).first_frequency == pytest.approx(30, rel=0.01)
    assert SirenField((256, 512), width=8, reach=0.075).first_frequency == pytest.approx(60, rel=0.01)


@pytest.mark.parametrize("width", [32, 100])
def test_siren_initial_weights_fill_bounds_of_paper(width: int):
    field = SirenField((64, 64), width=width, depth=3)
    first, *later = [*field.hidden, field.last]
    assert len(later) == 3 and first.weight.shape == (width, 2)
    for layer, bound in [(first, 1 / 2), *((layer, math.sqrt(6 / width) / 30) for layer in later)]:
        assert bound * 0.9 < float(layer.weight.detach().abs().max()) <= bound * (1 + 1e-6)
        assert float(layer.weight.detach().std()) == pytest.approx(bound / math.sqrt(3), rel=0.25), "evenly"


def test_siren_matches_loop_over_layers():
    size = (40, 20)
    field, uv = SirenField(size, width=6, depth=3, reach=0.2), torch.rand(10, 2)
    first = 0.2 * math.pi * 20
    h = (2 * uv - 1) * torch.tensor(size) / 40
    for layer, frequency in zip(field.hidden, (first, 30, 30), strict=True):
        h = torch.sin(frequency * (h @ layer.weight.T + layer.bias))
    expected = 0.5 + (h @ field.last.weight.T + field.last.bias) / 2
    torch.testing.assert_close(field(uv), expected, atol=1e-4, rtol=0)
