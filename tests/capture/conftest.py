from pathlib import Path

import pytest
from capture.views import SIX, SMALL

from nerf_lightning.capture.synthetic import Flaws, Truth, write_capture


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """A synthetic capture with a sheet of six tags: folders `calibration` and `photos`, eight photos each."""
    folder = tmp_path_factory.mktemp("capture")
    return folder, write_capture(folder, SIX, SMALL, 8, 8, Flaws(blur=0.5, noise=2.0), seed=3)
