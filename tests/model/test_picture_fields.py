import functools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from nerf_lightning.dataset import Picture, PixelDataModule, pixel_grid
from nerf_lightning.model import FourierField, HashGrid2DField, PictureField, PictureMLP, SirenField
from nerf_lightning.system import NeRF2D, constant, psnr
from tests.helpers.assert_close import run_with_threads

SIZES = pytest.mark.parametrize("size", [(40, 25), (1, 1), (1, 30)])
MAKERS: dict[str, Callable[[tuple[int, int]], PictureField]] = {
    "hash grid": HashGrid2DField,
    "octaves": lambda size: PictureMLP(size, None, width=64),
    "random sinusoids": lambda size: FourierField(size, features=32, spread=0.2, width=64),
    "sines": lambda size: SirenField(size, width=64, reach=0.3),
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
    """100 steps on a smooth picture leave less than a twentieth of the squared error of the best plain colour."""
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
        return [system.colours(view.uv)]

    view = data.held_out(0)
    (learned,) = run_with_threads(train, 1)  # steps so small are slower with two, and far slower on a busy machine
    assert psnr(learned, view.rgb) > psnr(view.rgb.mean(0).expand_as(view.rgb), view.rgb) + 13


@pytest.mark.parametrize("size", [(16, 12), (33, 7)])
def test_hash_grid_2d_finest_level_has_vertex_at_pixel_centre(size: tuple[int, int]):
    width, height = size
    field = HashGrid2DField(size, levels=3, log2_entries=8, coarsest=4)
    assert field.resolutions[-1] == (width - 1, height - 1)
    finest = sum(field.sizes[:-1])
    before = field(pixel_grid(height, width))
    for column, row in [(0, 0), (width - 1, height - 1), (3, 5), (10, 2)]:
        pixel = column + row * width
        changed = HashGrid2DField(size, levels=3, log2_entries=8, coarsest=4)
        changed.load_state_dict(field.state_dict())
        with torch.no_grad():
            changed.tables[finest + pixel] += 10
        moved = (changed(pixel_grid(height, width)) - before).abs().amax(1)
        assert moved[pixel] > 0.1
        moved[pixel] = 0
        assert moved.max() < 1e-3, "and no other pixel's"


@pytest.mark.parametrize(("size", "octaves"), [((1, 1), 1), ((64, 64), 6), ((256, 192), 8), ((60, 100), 7)])
def test_picture_mlp_octaves_end_at_half_of_nyquist(size: tuple[int, int], octaves: int):
    field = PictureMLP(size, None, width=8, depth=2)
    assert field.frequencies == octaves
    assert size == (1, 1) or 2 ** (octaves - 1) / 2 == pytest.approx(field.nyquist / 2, rel=0.42), (
        "to the nearest octave"
    )
    assert field.net[0].in_features == 2 * (1 + 2 * octaves)


def inputs_of(field: PictureField, uv: Tensor) -> Tensor:
    """What the first layer of a field's network sees."""
    seen: list[Tensor] = []
    with field.net[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0])):
        field(uv)
    return seen[0]


@pytest.mark.parametrize("size", [(8, 4), (3, 10), (1, 1)])
def test_picture_field_centred_pixels_stay_square(size: tuple[int, int]):
    width, height = size
    places = PictureField(size).centred(pixel_grid(height, width)).view(height, width, 2)
    step = 2 / max(size)
    torch.testing.assert_close(places.diff(dim=1), torch.tensor([step, 0.0]).expand(height, width - 1, 2))
    torch.testing.assert_close(places.diff(dim=0), torch.tensor([0.0, step]).expand(height - 1, width, 2))
    torch.testing.assert_close(places.mean((0, 1)), torch.zeros(2), atol=1e-6, rtol=0)
