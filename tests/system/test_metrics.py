import math

import pytest
import torch

from nerf_lightning.system import psnr, ssim


@pytest.mark.parametrize(
    ("error", "expected", "shape"), [(0.1, 20.0, (12, 9, 3)), (0.01, 40.0, (5, 3)), (1.0, 0.0, (1,))]
)
def test_psnr_known_error_has_expected_value(error, expected, shape):
    assert psnr(torch.full(shape, error), torch.zeros(shape)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_psnr_large_picture_in_parts_is_the_same(masked, monkeypatch):
    image, truth = torch.rand(2, 9, 5, 3)
    known = torch.rand(9, 5) > 0.4 if masked else None
    squares = (image.double() - truth.double()) ** 2
    expected = -10 * math.log10(float((squares if known is None else squares[known]).mean()))
    monkeypatch.setattr("nerf_lightning.system.metrics.AT_ONCE", 7)
    assert psnr(image, truth, known) == pytest.approx(expected, abs=1e-9)
    assert math.isnan(psnr(image, truth, torch.zeros(9, 5, dtype=torch.bool)))


def test_ssim_falls_with_noise():
    torch.manual_seed(0)
    truth = torch.rand(24, 16, 3)
    assert ssim(truth, truth) == pytest.approx(1)
    slight, strong = (ssim((truth + sigma * torch.randn(24, 16, 3)).clamp(0, 1), truth) for sigma in (0.05, 0.3))
    assert 0.9 < slight < 0.999 and strong < 0.7 * slight


def test_ssim_flat_pictures_follow_formula():
    a, b, c1 = 0.02, 0.06, 0.01**2  # Wang et al. 2004, eq. 6, with a range of 1
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert ssim(torch.full((16, 16, 3), a), torch.full((16, 16, 3), b)) == pytest.approx(expected, rel=1e-3)


def test_metrics_masked_pixels_do_not_count():
    image, truth = torch.rand(20, 24, 3), torch.rand(20, 24, 3)
    known = torch.rand(20, 24) < 0.6
    assert psnr(image, truth, known) == pytest.approx(psnr(image[known], truth[known]))
    spoiled = torch.where(known[..., None], truth, torch.rand(20, 24, 3))
    assert psnr(image, spoiled, known) == psnr(image, truth, known)
    assert ssim(image, spoiled, known) == pytest.approx(ssim(image, truth, known))
    assert ssim(image, truth, torch.ones_like(known)) == pytest.approx(ssim(image, truth))
    nothing = torch.zeros_like(known)
    assert math.isnan(psnr(image, truth, nothing)) and math.isnan(ssim(image, truth, nothing))
