"""Fixtures that tests of captures share."""

from pathlib import Path

import pytest

from benchmarks.synthetic.photos import Truth
from nerf_lightning.capture.run import Capture, capture_scene
from tests.helpers.shared_fixtures import make_once
from tests.helpers.tag_views import SIZE


@pytest.fixture(scope="session")
def packed(made: tuple[Path, Truth], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Capture]:
    """What a capture of it writes, in a folder, and returns."""

    def make(folder: Path) -> tuple[Path, Capture]:
        photos = made[0] / "calibration", made[0] / "photos"
        return folder, capture_scene(*photos, SIZE, folder / "scene.npz", longest=200, holdout=4)

    return make_once(tmp_path_factory, "packed", make)
