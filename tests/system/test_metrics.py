import math

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from nerf_lightning.system import metrics, psnr, ssim


def test_psnr_known_error_has_expected_value():
    for error, expected, shape in ((0.1, 20.0, (12, 9, 3)), (1.0, 0.0, (1,))):
        assert psnr(torch.full(shape, error), torch.zeros(shape)) == pytest.approx(expected, abs=1e-5)


def test_ssim_constant_images_match_formula():
    a, b, c1 = 0.02, 0.06, 0.01**2  # Wang et al. 2004, eq. 6, with a range of 1
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert ssim(torch.full((16, 16, 3), a), torch.full((16, 16, 3), b)) == pytest.approx(expected, rel=1e-3)


def test_metrics_masked_pixels_are_ignored():
    image, truth = torch.rand(20, 24, 3), torch.rand(20, 24, 3)
    known = torch.rand(20, 24) < 0.6
    assert psnr(image, truth, known) == pytest.approx(psnr(image[known], truth[known]))
    spoiled = torch.where(known[..., None], truth, torch.rand(20, 24, 3))
    assert psnr(image, spoiled, known) == psnr(image, truth, known)
    assert ssim(image, spoiled, known) == pytest.approx(ssim(image, truth, known))
    assert ssim(image, truth, torch.ones_like(known)) == pytest.approx(ssim(image, truth))
    nothing = torch.zeros_like(known)
    assert math.isnan(psnr(image, truth, nothing)) and math.isnan(ssim(image, truth, nothing))


@pytest.mark.parametrize("rows", [1, 20])
def test_ssim_chunks_match_whole_image(rows: int, monkeypatch: pytest.MonkeyPatch):
    image, truth = torch.rand(2, 37, 23, 3)
    whole = structural_similarity_index_measure(*(x.permute(2, 0, 1)[None] for x in (image, truth)), data_range=1.0)
    monkeypatch.setattr(metrics, "SSIM_CHUNK_ROWS", rows)
    assert ssim(image, truth) == pytest.approx(float(whole), abs=1e-5)


def test_ssim_separate_strips_gives_mean_of_strips():
    image, truth = torch.rand(2, 36, 23, 3)
    alone = [ssim(image[start : start + 12], truth[start : start + 12]) for start in (0, 12, 24)]
    assert ssim(image, truth, strip=12) == pytest.approx(sum(alone) / 3, abs=1e-6)
    assert math.isnan(ssim(image, truth, strip=1)), "separate rows have no windows"
