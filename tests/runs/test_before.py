"""Run folders and compact files stay readable: before/ holds what a version wrote before its modules moved."""

import json
import shutil
from pathlib import Path
from statistics import fmean

import pytest
import yaml

from nerf_lightning.runs.data import data_again
from nerf_lightning.runs.index import read_run
from nerf_lightning.runs.open import open_run
from nerf_lightning.utils.device import CPU

BEFORE = Path(__file__).parent / "before"


@pytest.mark.parametrize("name", ["run", "field.npz"])
def test_it_shows_what_it_showed(name: str):
    then = read_run(BEFORE / "run")
    found = open_run(BEFORE / name, CPU)
    data = data_again(found.cfg, found.scene)
    quality = fmean(found.system.evaluate(data.held_out(view)).psnr for view in range(data.held_out_views))
    assert then.status == "finished" and quality == pytest.approx(then.psnr, abs=0.02)


def test_it_goes_on(inside, tmp_path: Path):
    shutil.copytree(BEFORE / "run", tmp_path / "run")
    code, _, err = inside(f"resume={tmp_path}/run", "budget.steps=70")
    assert code == 0, err
    assert json.loads((tmp_path / "run" / "results.json").read_text(encoding="utf-8"))["steps"] == 70
    assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text(encoding="utf-8"))["budget"]["steps"] == 70
