"""SSIM by strips is SSIM of the whole."""

import math

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from nerf_lightning.system import metrics


@pytest.mark.parametrize("rows", [1, 20])
def test_ssim_strips_match_whole_picture(rows: int, monkeypatch: pytest.MonkeyPatch):
    image, truth = torch.rand(2, 37, 23, 3)
    whole = structural_similarity_index_measure(*(x.permute(2, 0, 1)[None] for x in (image, truth)), data_range=1.0)
    monkeypatch.setattr(metrics, "SSIM_ROWS", rows)
    assert metrics.ssim(image, truth) == pytest.approx(float(whole), abs=1e-5)


def test_ssim_separate_strips_are_averaged():
    image, truth = torch.rand(2, 36, 23, 3)
    alone = [metrics.ssim(image[start : start + 12], truth[start : start + 12]) for start in (0, 12, 24)]
    assert metrics.ssim(image, truth, strip=12) == pytest.approx(sum(alone) / 3, abs=1e-6)
    assert math.isnan(metrics.ssim(image, truth, strip=1)), "rows that lie apart have no windows"
