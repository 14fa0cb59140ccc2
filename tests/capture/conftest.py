"""Fixtures that tests of captures share."""

from pathlib import Path

import pytest

from benchmarks.synthetic.photos import Truth
from nerf_lightning.capture.pipeline import Capture, capture_scene
from tests.helpers.shared_fixtures import make_once
from tests.helpers.tag_views import TAG_SIZE


@pytest.fixture(scope="session")
def packed(tag_capture: tuple[Path, Truth], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Capture]:
    """Output folder and result of a capture."""

    def make(folder: Path) -> tuple[Path, Capture]:
        photos = tag_capture[0] / "calibration", tag_capture[0] / "photos"
        return folder, capture_scene(*photos, TAG_SIZE, folder / "scene.npz", max_side=200, holdout=4)

    return make_once(tmp_path_factory, "packed", make)
