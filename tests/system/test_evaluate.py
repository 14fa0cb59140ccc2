import functools
import math

import pytest
import torch
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.dataset import Picture, PictureBatch, PixelDataModule, ViewBatch
from nerf_lightning.dataset.picture import make_builtin_picture
from nerf_lightning.model import Field, PictureField, PictureMLP
from nerf_lightning.renderer import VolumeRenderer
from nerf_lightning.sampler import UniformSampler
from nerf_lightning.system import NeRF2D, NeRF3D, constant

ADAM_FACTORY = functools.partial(torch.optim.Adam, lr=0.01)


class Ramp(PictureField):
    """Red grows to the right, green downward; blue is more than a picture can show."""

    def forward(self, uv: Tensor) -> Tensor:
        return torch.cat([uv, torch.full_like(uv[:, :1], 1.5)], dim=1)


def picture_view(height: int, width: int, error: float) -> PictureBatch:
    image = torch.zeros(height, width, 3, dtype=torch.uint8)
    view = PixelDataModule(Picture("p", "test", image)).get_held_out_view(0)
    truth = torch.cat([view.uv, torch.ones_like(view.uv[:, :1])], dim=1) + error
    return PictureBatch(view.uv, truth, height, width)


@pytest.mark.parametrize(("error", "expected", "chunk"), [(0.1, 20, 4), (0.01, 40, 10_000)])
def test_evaluate_picture_clips_colors(error, expected, chunk):
    result = NeRF2D(Ramp((15, 12)), ADAM_FACTORY, constant, chunk=chunk).evaluate(picture_view(12, 15, error))
    assert result.psnr == pytest.approx(expected, abs=1e-3)
    assert result.rgb.shape == result.truth.shape == (12, 15, 3)
    assert result.rgb.max() <= 1 and (result.rgb[..., 2] == 1).all()
    torch.testing.assert_close(result.rgb[0, :, 0], (torch.arange(15) + 0.5) / 15)
    torch.testing.assert_close(result.rgb[:, 0, 1], (torch.arange(12) + 0.5) / 12)
    assert 0 < result.ssim <= 1 and result.seconds > 0
    assert result.depth is None and result.opacity is None


class Slab(Field):
    """An opaque red slab at z > 0.5, where x > 0."""

    def __init__(self, bounds: Bounds):
        super().__init__(bounds)
        self.red = torch.nn.Parameter(torch.tensor([1.0, 0, 0]))

    def features(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        return 1e6 * ((positions[:, 2] > 0.5) & (positions[:, 0] > 0)).float(), positions

    def color(self, features: Tensor, directions: Tensor) -> Tensor:
        return self.red.expand(len(features), 3)


@pytest.fixture
def slab() -> NeRF3D:
    bounds = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    return NeRF3D(Slab(bounds), UniformSampler(bounds, 200), VolumeRenderer("white"), ADAM_FACTORY, constant)


def slab_view(alpha: int) -> ViewBatch:
    """Blue where there is nothing, seen from z = -3; truth red at the right."""
    K = torch.tensor([[[40.0, 0, 8], [0, 40, 6], [0, 0, 1]]])
    c2w = torch.eye(4)[None].clone()
    c2w[0, 2, 3] = -3
    cameras = Cameras.pinhole(K, c2w, 16, 12)
    image = torch.tensor([0, 0, 255, alpha]).repeat(12, 16, 1)
    image[:, 8:] = torch.tensor([255, 0, 0, 255])
    return ViewBatch(cameras.generate_view_rays(0), image.to(torch.uint8).flatten(0, 1), 12, 16)


@pytest.mark.parametrize("chunk", [60, 10**6])
def test_evaluate_view_any_chunk_gives_same_scores(chunk, slab: NeRF3D):
    slab.chunk = chunk
    result = slab.evaluate(slab_view(alpha=0))
    assert result.psnr > 60, "blue under alpha 0 is not seen: the background is"
    assert result.ssim == pytest.approx(1, abs=1e-4)
    assert (result.opacity[:, 8:] > 0.999).all() and (result.opacity[:, :8] == 0).all()
    z = slab_view(0).rays.directions[:, 2].view(12, 16)[:, 8:]
    torch.testing.assert_close(result.depth[:, 8:] * z, torch.full_like(z, 3.5), atol=0.02, rtol=0)


def test_render_rays_outside_bounds_shows_background(slab: NeRF3D):
    away = Rays(torch.full((3, 3), 5.0), torch.eye(3))
    seen = slab.render(away)
    assert torch.equal(seen.rgb, torch.ones(3, 3)) and (seen.depth == 0).all()


@pytest.fixture
def sunset() -> PictureBatch:
    return PixelDataModule(Picture("sunset", "test", make_builtin_picture(20))).get_held_out_view(0)


def test_diagnose_constant_field_names_cause(sunset: PictureBatch):
    field = PictureMLP((20, 20), width=16)
    assert NeRF2D(field, ADAM_FACTORY, constant).diagnose(sunset) == ""
    field.net[-1].bias.data += 100  # saturates
    assert "same color" in NeRF2D(field, ADAM_FACTORY, constant).diagnose(sunset)


class Wave(PictureField):
    """A cosine of one cycle across the picture."""

    def forward(self, uv: torch.Tensor) -> torch.Tensor:
        return (0.5 + 0.4 * torch.cos(2 * torch.pi * uv[:, :1])).expand(-1, 3)


def test_measure_off_grid_psnr_wave_matches_closed_form(sunset):
    system = NeRF2D(Wave((20, 20)), ADAM_FACTORY, constant)
    # Neighboring samples of the wave differ by 18 degrees: their mean falls short of it by 1 - cos(9 degrees).
    expected = -10 * math.log10((0.4 * (1 - math.cos(math.radians(9)))) ** 2 / 2)
    found = system.measure_off_grid_psnr(PictureBatch(sunset.uv, system.query_rgb(sunset.uv), 20, 20))
    assert found == pytest.approx(expected, abs=0.3)
