"""Training with a torchvision that does not fit PyTorch, and LPIPS with one that does: packages made by the tests."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from nerf_lightning.evaluate import perceptual
from nerf_lightning.utils.libraries import SPIN_COUNT, shorten_openmp_waits
from tests.helpers.command_line import ROOT

BROKEN = "raise RuntimeError('operator torchvision::nms does not exist')"
FITTING = {
    "__init__.py": "from torchvision import models, ops, transforms",
    "ops.py": "box_area = box_iou = box_convert = distance_box_iou = generalized_box_iou = complete_box_iou = None",
    "transforms.py": "",
    "models.py": """
import torch
from torch.nn import Conv2d, MaxPool2d, ReLU, Sequential
class AlexNet_Weights:
    DEFAULT = None
resnet50 = vgg16 = VGG16_Weights = None
def alexnet(weights):
    torch.manual_seed(1)
    net = torch.nn.Module()
    net.features = Sequential(
        Conv2d(3, 64, 11, 4, 2), ReLU(), MaxPool2d(3, 2), Conv2d(64, 192, 5, padding=2), ReLU(), MaxPool2d(3, 2),
        Conv2d(192, 384, 3, padding=1), ReLU(), Conv2d(384, 256, 3, padding=1), ReLU(),
        Conv2d(256, 256, 3, padding=1), ReLU(), MaxPool2d(3, 2))
    return net
""",
}
MEASURE = """
import torch
from nerf_lightning.evaluate.perceptual import perceptual_distance
distance, why = perceptual_distance()
torch.manual_seed(0)
image = torch.rand(80, 80, 3)
print("LPIPS:", why, distance and (distance(image, image), distance(image, 1 - image) > 1e-4))
"""
TRAIN = """
import sys
from nerf_lightning.__main__ import main
sys.argv[1:] = ["+experiment=smoke_2d", "dataset.max_side=16", "budget.steps=2", "callbacks=null", "logger=null"]
sys.argv += ["hydra.run.dir=run"]
main()
"""


def run(code: str, folder: Path, files: dict[str, str]) -> list[str]:
    """The lines that code prints where there is a torchvision made of some files, and LPIPS' weights."""
    for name, text in files.items():
        (folder / "torchvision" / name).parent.mkdir(exist_ok=True)
        (folder / "torchvision" / name).write_text(text)
    metadata, weights = folder / "torchvision-0.28.0.dist-info", folder / "home" / "hub" / "checkpoints"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: torchvision\nVersion: 0.28.0\n")
    weights.mkdir(parents=True)
    (weights / perceptual.WEIGHTS).touch()
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "TORCH_HOME": str(folder / "home")}
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return [*done.stdout.splitlines(), *done.stderr.splitlines()]


def test_torchvision_for_another_pytorch_costs_one_warning(tmp_path: Path):
    lines = run(TRAIN + MEASURE, tmp_path, {"__init__.py": BROKEN})
    assert (tmp_path / "run" / "results.json").exists()
    lpips, warning = sorted((line for line in lines if "torchvision" in line), key=lambda line: "LPIPS: " not in line)
    assert "torchvision does not fit PyTorch" in warning and "pip install --force-reinstall" in warning
    assert "operator torchvision::nms does not exist" in warning
    assert lpips == f"LPIPS: {warning.removeprefix('WARNING: ')} None"


def test_fitting_torchvision_measures_lpips(tmp_path: Path):
    lines = run(MEASURE, tmp_path, FITTING)
    assert lines == ["LPIPS:  (0.0, True)"]


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
