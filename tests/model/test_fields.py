from collections.abc import Callable

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.model import Field, HashGridField, MLPField, TensoRFField

BOX = torch.tensor([[-1.0, -0.5, 0.2], [1.5, 2.0, 1.0]])


def mlp(bounds: Bounds) -> Field:
    return MLPField(bounds, 3, 16, skip=2, position_frequencies=3, direction_frequencies=2, density="softplus")


def hashgrid(bounds: Bounds) -> Field:
    field = HashGridField(bounds, num_levels=3, log2_hashmap_size=8, base_resolution=3, max_resolution=12, width=8)
    torch.nn.init.normal_(field.grid.tables)
    return field


def tensorf(bounds: Bounds) -> Field:
    field = TensoRFField(bounds, 3, 8, base_resolution=4, max_resolution=4, stages=1, width=8)
    for parameter in (*field.density_volume.parameters(), *field.color_volume.parameters()):
        torch.nn.init.normal_(parameter)
    return field


FIELDS = pytest.mark.parametrize("make", [mlp, hashgrid, tensorf])
Make = Callable[[Bounds], Field]


def random_positions(count: int) -> torch.Tensor:
    return BOX[0] + torch.rand(count, 3) * (BOX[1] - BOX[0])


def random_directions(count: int) -> torch.Tensor:
    return normalize(torch.randn(count, 3), dim=-1)


@FIELDS
@pytest.mark.parametrize(("unbounded", "count"), [(False, 0), (True, 50)])
def test_field_any_positions_gives_density_and_color(make: Make, unbounded: bool, count: int):
    field, positions = make(Bounds(BOX, unbounded)), random_positions(count) * 3
    density, rgb, _ = field(positions, random_directions(count))
    assert density.shape == (count,) and rgb.shape == (count, 3)
    assert (density >= 0).all() and density.isfinite().all()
    assert (rgb >= 0).all() and (rgb <= 1).all()
    assert torch.equal(density, field.density(positions))
    if count > 1:
        assert density.std() > 0 and rgb.std(0).min() > 0


@FIELDS
def test_field_other_unit_of_length_gives_same_colors(make: Make):
    small, large = make(Bounds(BOX)), make(Bounds(BOX * 10))
    large.load_state_dict(small.state_dict())
    positions, directions = random_positions(40), random_directions(40)
    (density, rgb, _), (density10, rgb10, _) = small(positions, directions), large(positions * 10, directions)
    torch.testing.assert_close(density10 * 10, density, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(rgb10, rgb, rtol=1e-3, atol=1e-4)


@FIELDS
def test_field_every_parameter_gets_gradient(make: Make):
    field = make(Bounds(BOX))
    density, rgb, _ = field(random_positions(500), random_directions(500))
    (density.sum() + rgb.square().sum()).backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_mlp_field_skip_layer_sees_position_again():
    field = MLPField(Bounds(BOX), depth=4, width=16, skip=3, position_frequencies=2)
    assert [layer.in_features for layer in field.trunk] == [15, 16, 16, 16 + 15]
    for skip in (-1, 0, 3, 4):
        with pytest.raises(InputError, match="model.skip"):
            MLPField(Bounds(BOX), depth=3, width=16, skip=skip)
