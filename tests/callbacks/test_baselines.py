import json
import math

import numpy as np
import pytest

from nerf_lightning.callbacks import Baselines, Evaluation
from nerf_lightning.callbacks.picture.baselines import jpegs, quality_of, shrunk, words
from nerf_lightning.callbacks.results import artifact_bytes
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.dataset.sources import from_picture


@pytest.fixture(scope="module")
def sunset() -> np.ndarray:
    return builtin_picture(40).numpy()


def test_quality_of_lossless_is_none(sunset):
    assert quality_of(sunset, sunset.copy()) is None and words(None) == "without loss"
    off_by_one = np.where(sunset > 127, sunset - 1, sunset + 1).astype(np.uint8)
    assert quality_of(sunset, off_by_one) == pytest.approx(20 * math.log10(255), abs=1e-4)


def test_shrunk_picture_keeps_proportions_within_bytes(sunset):
    wide = sunset[:20]
    assert [shrunk(wide, 2400 // n**2)["width"] for n in (1, 2, 4, 5)] == [40, 20, 10, 8]
    limits = (30, 100, 700, 1500, 2399)
    found = [shrunk(wide, limit) for limit in limits]
    for one, limit in zip(found, limits, strict=True):
        assert one["bytes"] == 3 * one["width"] * one["height"] <= limit
    qualities = [one["psnr"] for one in found]
    assert qualities == sorted(qualities) and qualities[-1] > qualities[0] + 3


@pytest.mark.parametrize(("size", "quality"), [(2000, 25.0), (2000, None), (100, 25.0)])
def test_baselines_after_test_compare_same_bytes(
    size, quality, sunset, trainer_with, system, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("nerf_lightning.callbacks.picture.baselines.artifact_bytes", lambda system: size)
    evaluation = Evaluation()
    evaluation.views = [] if quality is None else [{"psnr": quality, "ssim": 0.9}]
    trainer = trainer_with(evaluation)
    trainer.datamodule = from_picture(max_side=40)
    Baselines().on_test_end(trainer, system)
    found, text = json.loads((tmp_path / "baselines.json").read_text()), capsys.readouterr().out
    coded = jpegs(sunset)
    small = [one["psnr"] for one in coded if one["bytes"] <= size]
    good = [one["bytes"] for one in coded if quality is not None and one["psnr"] >= quality]
    assert (found["bytes"], found["picture_bytes"], found["field"]) == (size, 4800, quality)
    assert (found["jpeg"]["psnr"] == max(small) if small else found["jpeg"] is None) and (size > 100) == bool(small)
    assert found["jpeg_as_good"]["bytes"] == min(good) if good else found["jpeg_as_good"] is None
    assert found["bicubic"] == shrunk(sunset, size)
    assert ("none that small" in text) == (size == 100) and ("as good as" in text) == (quality is not None)


def test_artifact_bytes_counts_weights_and_buffers(system):
    assert artifact_bytes(system) == 4
