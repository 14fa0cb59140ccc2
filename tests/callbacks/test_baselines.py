import json
import math

import numpy as np
import pytest

from nerf_lightning.callbacks import Baselines, Results
from nerf_lightning.callbacks.picture.baselines import (
    SAMPLINGS,
    best_jpeg,
    jpeg,
    jpeg_as_good,
    quality_of,
    shrunk,
    words,
)
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.sources import from_picture


@pytest.fixture(scope="module")
def sunset() -> np.ndarray:
    return builtin_picture(40).numpy()


@pytest.fixture(scope="module")
def all_jpegs(sunset: np.ndarray) -> list[dict]:
    """Every JPEG there is of it."""
    coded = [(q, *jpeg(sunset, q, s)) for s in SAMPLINGS for q in range(1, 101)]
    return [{"quality": q, "bytes": size, "psnr": quality_of(image, sunset)} for q, size, image in coded]


def test_quality_of_lossless_is_none(sunset):
    assert quality_of(sunset, sunset.copy()) is None and words(None) == "without loss"
    assert quality_of(sunset, np.where(sunset > 127, sunset - 1, sunset + 1).astype(np.uint8)) == pytest.approx(
        20 * math.log10(255), abs=1e-4
    )
    assert words(48.1308) == "48.13 dB"


@pytest.mark.parametrize("limit", [1000, 2500, 10**6])
def test_best_jpeg_of_size_is_best_of_all(limit: int, sunset, all_jpegs):
    found = best_jpeg(sunset, limit)
    assert found in all_jpegs and found["bytes"] <= limit
    assert found["psnr"] == max(one["psnr"] for one in all_jpegs if one["bytes"] <= limit)


def test_best_jpeg_below_smallest_is_none(sunset, all_jpegs):
    smallest = min(one["bytes"] for one in all_jpegs)
    assert best_jpeg(sunset, smallest - 1) is None and best_jpeg(sunset, smallest)["bytes"] == smallest
    assert best_jpeg(sunset, 0) is None


@pytest.mark.parametrize("wanted", [20.0, 33.0])
def test_jpeg_as_good_is_smallest_of_them(wanted: float, sunset, all_jpegs):
    found = jpeg_as_good(sunset, wanted)
    assert found in all_jpegs and found["psnr"] >= wanted
    assert found["bytes"] == min(one["bytes"] for one in all_jpegs if one["psnr"] >= wanted)


def test_shrunk_picture_keeps_proportions_within_bytes(sunset):
    wide = sunset[:20]
    assert [shrunk(wide, 2400 // n**2)["width"] for n in (1, 2, 4, 5)] == [40, 20, 10, 8]
    found = [shrunk(wide, limit) for limit in (3, 30, 100, 700, 1500, 2399)]
    for one, limit in zip(found, (3, 30, 100, 700, 1500, 2399), strict=True):
        assert one["bytes"] == 3 * one["width"] * one["height"] <= limit
    qualities = [one["psnr"] for one in found]
    assert qualities == sorted(qualities) and qualities[-1] > qualities[0] + 3


def results_with(size: int, quality: float | None) -> Results:
    results = Results("results.json", "grey", 0)
    results.summary = {"artifact_bytes": size, "psnr": quality}
    return results


@pytest.mark.parametrize(
    ("size", "quality", "said"),
    [
        (2000, 25.0, ["JPEG 3", "interpolation 2", "as good as the field"]),
        (2000, None, ["JPEG 3", "interpolation 2"]),
        (100, 25.0, ["JPEG none that small", "interpolation 1"]),
    ],
)
def test_baselines_after_test_compare_same_bytes(size, quality, said, sunset, trainer_with, system, tmp_path, capsys):
    trainer = trainer_with(results_with(size, quality))
    trainer.datamodule = from_picture(max_side=40)
    Baselines().on_test_end(trainer, system)
    found = json.loads((tmp_path / "baselines.json").read_text())
    assert found == {
        "bytes": size,
        "picture_bytes": 4800,
        "field": quality,
        "jpeg": best_jpeg(sunset, size),
        "bicubic": shrunk(sunset, size),
        "jpeg_as_good": None if quality is None else jpeg_as_good(sunset, quality),
    }
    told = capsys.readouterr().out
    assert all(part in told for part in said), told
    assert ("as good as" in told) == (found["jpeg_as_good"] is not None)
