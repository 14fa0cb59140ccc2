"""Other packages: how OpenMP waits, and a torchvision that does not fit PyTorch."""

import os

import pytest

from nerf_lightning.cli.app import find_cause
from nerf_lightning.utils.libraries import SPIN_COUNT, shorten_openmp_waits


def test_torchvision_for_another_pytorch_says_how_to_mend_it():
    found = find_cause(RuntimeError("operator torchvision::nms does not exist"))
    assert "pip install --force-reinstall --no-deps torchvision" in str(found)


@pytest.mark.parametrize(
    ("given", "expected"),
    [({}, str(SPIN_COUNT)), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "ACTIVE"}, None)],
)
def test_openmp_waits_briefly_unless_told_otherwise(given: dict, expected: str | None, monkeypatch: pytest.MonkeyPatch):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.setenv(name, "")  # so that it is as before afterwards
        monkeypatch.delenv(name)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    shorten_openmp_waits()
    assert os.environ.get("GOMP_SPINCOUNT") == expected
