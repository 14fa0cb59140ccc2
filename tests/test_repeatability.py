"""The same seed gives the same weights, to the last bit: in another process, and across an interruption."""

import json
import os
import subprocess
import sys
from pathlib import Path

from every_model import ANOTHER, MODELS

ROOT = Path(__file__).resolve().parents[1]


def start(folder: Path, stop: int) -> subprocess.Popen[str]:
    line = [sys.executable, str(ROOT / "tests" / "every_model.py"), str(folder), str(stop)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(line, env={**os.environ, "PYTHONPATH": str(ROOT)}, **pipes)


def prints_of(process: subprocess.Popen[str]) -> dict[str, str]:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])


def test_every_shipped_model_is_among_them():
    assert set(MODELS) == {file.stem for file in (ROOT / "conf" / "model").glob("*.yaml")}


def test_same_seed_same_weights_in_another_process_and_across_an_interruption(tmp_path: Path):
    whole, broken = start(tmp_path / "whole", 0), start(tmp_path / "broken", 11)
    first, second = prints_of(whole), prints_of(broken)
    assert set(first) == {*MODELS, ANOTHER}
    for name in first:
        assert first[name] == second[name], name
    assert first[ANOTHER] != first["siren"], "another seed must give other weights"
