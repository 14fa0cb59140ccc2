"""Picture fields: training, positions of vertices, frequencies, and initialization."""

import functools
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nerf_lightning.dataset import Picture, PixelDataModule, pixel_grid
from nerf_lightning.model import FourierField, HashGrid2DField, PictureField, PictureMLP, SirenField
from nerf_lightning.system import NeRF2D, constant, psnr
from tests.helpers.kernel_comparison import run_with_threads

SIZES = pytest.mark.parametrize("size", [(40, 25), (1, 1), (1, 30)])
MAKERS: dict[str, Callable[[tuple[int, int]], PictureField]] = {
    "hash grid": HashGrid2DField,
    "octaves": lambda size: PictureMLP(size, None, width=64),
    "random sinusoids": lambda size: FourierField(size, num_frequencies=32, frequency_std=0.2, width=64),
    "sines": lambda size: SirenField(size, width=64, first_frequency=0.3),
}
FIELDS = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


@FIELDS
@SIZES
def test_picture_field_any_size_learns_with_all_parameters(make, size: tuple[int, int]):
    field = make(size)
    for uv in (torch.rand(0, 2), torch.rand(1, 2), pixel_grid(size[1], size[0]), torch.rand(30, 2)):
        rgb = field(uv)
        assert rgb.shape == (len(uv), 3) and rgb.isfinite().all()
    rgb.square().sum().backward()
    for name, parameter in field.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


@FIELDS
def test_picture_field_smooth_picture_is_learned(make):
    """100 steps reduce the squared error below a twentieth of that of the best constant color."""
    x, y = pixel_grid(48, 64).T
    smooth = torch.stack([0.5 + 0.4 * torch.sin(5 * x), 0.5 + 0.4 * torch.cos(4 * y + 2 * x), 0.2 + 0.6 * x * y], dim=1)
    image = (255 * smooth).round().byte().view(48, 64, 3)
    data = PixelDataModule(Picture("smooth", "test", image), pixels=512)
    system = NeRF2D(make((64, 48)), functools.partial(torch.optim.Adam, lr=1e-2), constant)

    def train() -> list[Tensor]:
        optimizer = system.configure_optimizers()
        for step in range(100):
            system.set_learning_rates(optimizer, step)
            optimizer.zero_grad()
            system.training_step(data.draw(step), step).backward()
            optimizer.step()
        return [system.query_rgb(view.uv)]

    view = data.get_held_out_view(0)
    (learned,) = run_with_threads(train, 1)  # two threads are slower for such small steps
    assert psnr(learned, view.rgb) > psnr(view.rgb.mean(0).expand_as(view.rgb), view.rgb) + 13


@pytest.mark.parametrize("size", [(16, 12), (33, 7)])
def test_hash_grid_2d_last_level_has_vertex_at_pixel_center(size: tuple[int, int]):
    width, height = size
    field = HashGrid2DField(size, num_levels=3, log2_hashmap_size=8, base_resolution=4)
    assert field.grid.cells[-1] == (width - 1, height - 1)
    last_level = sum(field.grid.sizes[:-1])
    before = field(pixel_grid(height, width))
    for column, row in [(0, 0), (width - 1, height - 1), (3, 5), (10, 2)]:
        pixel = column + row * width
        changed = HashGrid2DField(size, num_levels=3, log2_hashmap_size=8, base_resolution=4)
        changed.load_state_dict(field.state_dict())
        with torch.no_grad():
            changed.grid.tables[last_level + pixel] += 10
        moved = (changed(pixel_grid(height, width)) - before).abs().amax(1)
        assert moved[pixel] > 0.1
        moved[pixel] = 0
        assert moved.max() < 1e-3, "and no other pixel's"


def test_fourier_field_cycles_are_of_longer_side():
    size = (32, 64)
    field, uv = FourierField(size, num_frequencies=5, width=8), torch.rand(20, 2)
    lengths = (uv - 0.5) * torch.tensor(size) / 64
    angles = torch.tensor([[2 * math.pi * float(at @ field.cycles[:, k]) for k in range(5)] for at in lengths.unbind()])
    expected = torch.sigmoid(field.net(torch.cat([angles.sin(), angles.cos()], dim=1)))
    torch.testing.assert_close(field(uv), expected, atol=1e-4, rtol=0)


def test_siren_initial_weights_fill_bounds_of_paper():
    width = 100
    field = SirenField((64, 64), width=width, depth=3)
    first, *later = [*field.hidden, field.last]
    assert len(later) == 3 and first.weight.shape == (width, 2)
    for layer, bound in [(first, 1 / 2), *((layer, math.sqrt(6 / width) / 30) for layer in later)]:
        assert bound * 0.9 < float(layer.weight.detach().abs().max()) <= bound * (1 + 1e-6)
        assert float(layer.weight.detach().std()) == pytest.approx(bound / math.sqrt(3), rel=0.25), "evenly"


def test_siren_matches_loop_over_layers():
    size = (40, 20)
    field, uv = SirenField(size, width=6, depth=3, first_frequency=0.2), torch.rand(10, 2)
    first = 0.2 * math.pi * 20
    h = (2 * uv - 1) * torch.tensor(size) / 40
    for layer, frequency in zip(field.hidden, (first, 30, 30), strict=True):
        h = torch.sin(frequency * (h @ layer.weight.T + layer.bias))
    expected = 0.5 + (h @ field.last.weight.T + field.last.bias) / 2
    torch.testing.assert_close(field(uv), expected, atol=1e-4, rtol=0)
