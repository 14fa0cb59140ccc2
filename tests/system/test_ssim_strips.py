"""SSIM by strips is SSIM of the whole."""

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from nerf_lightning.system import metrics


@pytest.mark.parametrize("rows", [1, 7, 20, 1000])
def test_strips_change_nothing(rows: int, monkeypatch: pytest.MonkeyPatch):
    image, truth = torch.rand(2, 37, 23, 3)
    whole = structural_similarity_index_measure(*(x.permute(2, 0, 1)[None] for x in (image, truth)), data_range=1.0)
    monkeypatch.setattr(metrics, "SSIM_ROWS", rows)
    assert metrics.ssim(image, truth) == pytest.approx(float(whole), abs=1e-5)
