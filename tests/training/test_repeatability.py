"""The same seed gives the same weights, to the last bit: in another process, and across an interruption."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from tests.helpers.train_models import MODELS, OTHER_SEED, train_fingerprints

ROOT = Path(__file__).resolve().parents[2]


def test_repeatability_covers_every_shipped_model():
    assert set(MODELS) == {file.stem for file in (ROOT / "conf" / "model").glob("*.yaml")}


@pytest.fixture
def threads() -> Iterator[None]:
    """Restores process-wide settings after each test."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_train_same_seed_gives_same_weights_across_processes(threads: None, tmp_path: Path):
    line = [sys.executable, str(ROOT / "tests" / "helpers" / "train_models.py"), str(tmp_path / "broken"), "6"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(line, env={**os.environ, "PYTHONPATH": str(ROOT)}, **pipes) as process:
        first = train_fingerprints(tmp_path / "whole", 0)
        out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    second = json.loads(out.splitlines()[-1])
    assert set(first) == set(second) == {*MODELS, OTHER_SEED}
    for name in first:
        assert first[name] == second[name], name
    assert first[OTHER_SEED] != first["siren"], "another seed must give other weights"
