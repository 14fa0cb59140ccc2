"""Reading runs for tables and charts, whole ones and broken ones."""

import json
from pathlib import Path

import pytest
import yaml

from nerf_lightning.errors import InputError
from nerf_lightning.runs.summaries import find_runs, find_varying_options, read_run


def made(root: Path, name: str, config: dict | None = None, results: object = None) -> Path:
    folder = root / name
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config or {"seed": 0}, sort_keys=False))
    if results is not None:
        (folder / "results.json").write_text(results if isinstance(results, str) else json.dumps(results))
    return folder


def test_read_run_reads_results_and_options(tmp_path: Path):
    results = {"psnr": 31.5, "status": "finished", "diagnosis": "", "curve": [[0.5, 10, 20], [1.0, 20, 31.5]]}
    run = read_run(made(tmp_path, "a", {"model": {"width": 16}}, results))
    assert (run.psnr, run.status, run.diagnosis) == (31.5, "finished", "")
    assert run.curve == [(0.5, 10, 20), (1.0, 20, 31.5)]
    assert (
        run.get_option("model.width") == 16
        and run.get_option("model.depth") is None
        and run.get_option("seed.x") is None
    )


@pytest.mark.parametrize(
    ("results", "status", "word"),
    [
        (None, "unfinished", "no results.json"),
        ('{"psnr": 3', "unreadable", "results.json"),
        ("[1, 2]", "unreadable", "list"),
        ({"psnr": None, "status": "failed", "diagnosis": "out of memory", "curve": None}, "failed", "out of memory"),
        ({"psnr": "high", "status": "finished", "curve": [[1, 2], "x", [1, 2, "y"]]}, "finished", ""),
    ],
)
def test_read_run_broken_results_have_no_metrics(results: object, status: str, word: str, tmp_path: Path):
    run = read_run(made(tmp_path, "a", None, results))
    assert run.status == status and word in run.diagnosis
    assert run.psnr is None and run.curve == []


def test_find_runs_folder_without_runs_raises(tmp_path: Path):
    with pytest.raises(InputError, match="no such folder"):
        find_runs(tmp_path / "missing")
    with pytest.raises(InputError, match="no run in it"):
        find_runs(tmp_path)


def test_find_varying_options_lists_differences(tmp_path: Path):
    each = [(seed, {"_target_": "x", "width": width}) for seed in (0, 1) for width in (16, 64)]
    configs = [{"seed": seed, "dataset": {"seed": seed}, "model": model, "method": "m"} for seed, model in each]
    runs = [read_run(made(tmp_path, str(i), config)) for i, config in enumerate(configs)]
    assert find_varying_options(runs) == ["seed", "model.width"], "dataset.seed only repeats the seed"
    assert find_varying_options(runs[:1]) == [] and find_varying_options([]) == []
    other = configs[0] | {"method": "n", "model": {"_target_": "y", "width": 3, "depth": 2}}
    runs.append(read_run(made(tmp_path, "other", other)))
    assert find_varying_options([runs[0], runs[-1]]) == ["method"], "another kind of model differs in everything"
    runs.append(read_run(made(tmp_path, "broken", None)))
    (runs[-1].folder / "config.yaml").unlink()
    assert find_varying_options([*runs[:4], read_run(runs[-1].folder)]) == ["seed", "model.width"], (
        "one without a configuration is no reason"
    )
