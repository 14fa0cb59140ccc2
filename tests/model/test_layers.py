"""Activations, encodings, hash-grid levels, and the degree of view dependence."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import hash_interpolate
from nerf_lightning.model import HashGrid, HashGridField, TensoRFField, density_activation, sinusoidal, truncated_exp
from nerf_lightning.model.hashgrid import cubic_cells, level_resolutions


def test_truncated_exp_any_input_keeps_gradient():
    x = torch.tensor([-1e4, -20.0, -1.0, 0.0, 3.0, 15.0, 16.0, 1e4], requires_grad=True)
    y = truncated_exp(x)
    torch.testing.assert_close(y, torch.tensor([math.exp(min(v, 15)) for v in x.tolist()]))
    y.sum().backward()
    torch.testing.assert_close(x.grad, torch.tensor([math.exp(max(-15, min(v, 15))) for v in x.tolist()]))
    assert (x.grad > 0).all(), "neither vanishes"
    assert torch.autograd.gradcheck(truncated_exp, torch.linspace(-10, 10, 9).double().requires_grad_())


def test_density_activation_each_name_follows_formula():
    x, softplus = torch.tensor([0.0, 3.0, -5.0]), lambda x: (x - 1).exp().log1p()
    for name, formula in (("relu", torch.relu), ("softplus", softplus), ("exp", torch.exp)):
        torch.testing.assert_close(density_activation(name)(x), formula(x))


def test_softenable_relu_softened_is_softplus_and_saved():
    softened, loaded = density_activation("relu"), density_activation("relu")
    softened.soften()
    loaded.load_state_dict(softened.state_dict())
    x = torch.linspace(-3, 3, 7)
    for relu in (softened, loaded):
        assert torch.equal(relu(x), density_activation("softplus")(x))


@pytest.mark.parametrize(("name", "dtype"), [("softplus", torch.float16), ("exp", torch.bfloat16)])
def test_density_activation_half_precision_stays_finite(name: str, dtype: torch.dtype):
    x = torch.tensor([-1e4, -20.0, 0.0, 12.0, 1e4], dtype=dtype, requires_grad=True)
    values = density_activation(name)(x)
    values.float().sum().backward()
    assert values.isfinite().all() and x.grad.isfinite().all()
    assert values[3] > 0.9 * (11 if name == "softplus" else math.exp(12)), "e^12 is beyond half precision"


@pytest.mark.parametrize(("frequencies", "shape"), [(0, (5, 3)), (4, (2, 3, 2))])
def test_sinusoidal_any_shape_matches_loop(frequencies, shape):
    x = torch.randn(shape)
    waves = [wave(2**octave * math.pi * x) for octave in range(frequencies) for wave in (torch.sin, torch.cos)]
    torch.testing.assert_close(sinusoidal(x, frequencies), torch.cat([x, *waves], dim=-1), atol=1e-5, rtol=1e-5)


def test_level_resolutions_grow_from_base_to_max():
    assert level_resolutions(1, 16, 256) == [16] and level_resolutions(5, 16, 256) == [16, 32, 64, 128, 256]
    with pytest.raises(InputError, match="model.base_resolution"):
        level_resolutions(2, 20, 10)


def test_hash_grid_small_levels_have_one_entry_a_vertex():
    grid = HashGrid(cubic_cells(3, 4, 16), log2_hashmap_size=9, features_per_level=4)
    assert grid.cells == [(4,) * 3, (8,) * 3, (16,) * 3] and grid.sizes == [125, 512, 512]
    assert grid.tables.shape == (125 + 512 + 512, 4) and grid.width == 12
    assert 0 < grid.tables.abs().max() <= 1e-4
    unit = torch.rand(7, 3)
    assert torch.equal(grid(unit), hash_interpolate(grid.tables, unit, grid.cells, grid.sizes))


BOX = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("kind", [TensoRFField, HashGridField])
def test_colors_vary_with_direction_up_to_degree(kind: type, degree: int, kernels: str):
    """With all ReLUs active, color logits are polynomials of that degree: on a circle their Fourier series ends there."""
    field = kind(BOX, degree=degree, width=8)
    first, *others = field.color_net
    first.bias.data += 4.0
    for layer in others:
        layer.weight.data -= layer.weight.data.mean(1, keepdim=True)  # cancels the constant 4 of the layer before
        layer.bias.data.fill_(4.0 if layer is not others[-1] else 0.0)
    turn = torch.arange(16) * (2 * torch.pi / 16)
    plane = torch.linalg.qr(torch.randn(3, 2)).Q
    directions = normalize(torch.stack([turn.cos(), turn.sin()], dim=1) @ plane.T, dim=1)
    logits = torch.special.logit(field(torch.full((16, 3), 0.3), directions)[1].double())
    waves = torch.fft.rfft(logits - logits.mean(0), dim=0).abs()
    assert waves[degree + 1 :].max() < 1e-3
    assert degree == 0 or waves[degree].max() > 1e-2
