import math

import jaxtyping
import pytest
import torch

from nerf_lightning.system import psnr, ssim


@pytest.mark.parametrize(("error", "expected"), [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0), (0.5, 10 * math.log10(4))])
@pytest.mark.parametrize("shape", [(12, 9, 3), (5, 3), (1,)])
def test_psnr_of_a_known_error(error, expected, shape):
    assert psnr(torch.full(shape, error), torch.zeros(shape)) == pytest.approx(expected, abs=1e-5)


def test_psnr_averages_squares_before_the_logarithm():
    assert psnr(torch.tensor([0.1, 0.3]), torch.zeros(2)) == pytest.approx(-10 * math.log10(0.05), abs=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_psnr_of_a_large_picture_is_computed_in_parts(masked, monkeypatch):
    image, truth = torch.rand(2, 9, 5, 3)
    known = torch.rand(9, 5) > 0.4 if masked else None
    squares = (image.double() - truth.double()) ** 2
    expected = -10 * math.log10(float((squares if known is None else squares[known]).mean()))
    monkeypatch.setattr("nerf_lightning.system.metrics.AT_ONCE", 7)
    assert psnr(image, truth, known) == pytest.approx(expected, abs=1e-9)
    assert math.isnan(psnr(image, truth, torch.zeros(9, 5, dtype=torch.bool)))


def test_psnr_of_the_same_picture_is_finite():
    assert psnr(torch.rand(4, 3), torch.rand(4, 3)) < 30
    assert psnr(torch.ones(4, 3), torch.ones(4, 3)) == pytest.approx(120)


def test_ssim():
    torch.manual_seed(0)
    truth = torch.rand(24, 16, 3)
    assert ssim(truth, truth) == pytest.approx(1)
    slight, strong = (ssim((truth + sigma * torch.randn(24, 16, 3)).clamp(0, 1), truth) for sigma in (0.05, 0.3))
    assert 0.9 < slight < 0.999 and strong < 0.7 * slight


def test_ssim_of_flat_pictures_compares_their_brightness():
    a, b, c1 = 0.02, 0.06, 0.01**2  # Wang et al. 2004, eq. 6, with a range of 1
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert ssim(torch.full((16, 16, 3), a), torch.full((16, 16, 3), b)) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("height", "width"), [(10, 30), (30, 10), (1, 1)])
def test_ssim_of_pictures_below_its_window_is_not_a_number(height, width):
    assert math.isnan(ssim(torch.rand(height, width, 3), torch.rand(height, width, 3)))


def test_only_known_pixels_are_scored():
    image, truth = torch.rand(20, 24, 3), torch.rand(20, 24, 3)
    known = torch.rand(20, 24) < 0.6
    assert psnr(image, truth, known) == pytest.approx(psnr(image[known], truth[known]))
    spoiled = torch.where(known[..., None], truth, torch.rand(20, 24, 3))
    assert psnr(image, spoiled, known) == psnr(image, truth, known)
    assert ssim(image, spoiled, known) == pytest.approx(ssim(image, truth, known))
    assert ssim(image, truth, torch.ones_like(known)) == pytest.approx(ssim(image, truth))
    nothing = torch.zeros_like(known)
    assert math.isnan(psnr(image, truth, nothing)) and math.isnan(ssim(image, truth, nothing))


def test_pictures_of_different_sizes_are_refused_in_tests():
    for call in (psnr, ssim):
        with pytest.raises(jaxtyping.TypeCheckError):
            call(torch.zeros(12, 12, 3), torch.zeros(12, 1, 3))
