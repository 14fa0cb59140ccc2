"""Sweeps: jobs run once, resume where they stopped, and fail independently."""

import csv
import json
import re
import signal
from pathlib import Path

import pytest

from nerf_lightning.runs.run_lock import lock_folder
from tests.helpers.command_line import BARE, run_process

SMALL = ["+experiment=smoke_2d", "dataset.max_side=16", "budget.steps=3"]


def table(root: Path) -> dict[str, dict[str, str]]:
    with (root / "sweep.csv").open() as file:
        return {row["job"]: row for row in csv.DictReader(file)}


def test_sweep_rerun_skips_finished_jobs(run_cli, tmp_path: Path):
    command = ["-m", *SMALL, "callbacks.pictures=null", "model.width=8,16", "seed=1"]
    code, out, err = run_cli(*command)
    name = "sweep_budget.steps=3_callbacks.pictures=null_dataset.max_side=16_model.width=8,16_seed=1"
    root = tmp_path / "outputs" / "smoke_2d" / name
    assert code == 0, err
    names = {f"model.width={width}" for width in (8, 16)}
    assert {path.name for path in root.iterdir() if path.is_dir()} == names
    rows = table(root)
    assert set(rows) == names and {row["status"] for row in rows.values()} <= {"finished", "collapsed"}
    assert rows["model.width=8"]["model.width"] == "8" and float(rows["model.width=8"]["psnr"]) > 3
    assert all((root / f"compare.{kind}").stat().st_size > 200 for kind in ("html", "png", "csv"))
    results = {name: (root / name / "results.json").stat().st_mtime_ns for name in names}
    code, out, err = run_cli(*command)
    assert code == 0 and out.count("done before") == 2 and ": starts" not in out
    assert {name: (root / name / "results.json").stat().st_mtime_ns for name in names} == results


def test_sweep_failed_job_is_reported_and_others_continue(run_cli, tmp_path: Path):
    code, out, err = run_cli("-m", *SMALL, *BARE, "model.width=-1,8")
    (root,) = (tmp_path / "outputs" / "smoke_2d").iterdir()
    assert code == 1
    assert "nerf_lightning: 1 of 2 jobs are not done: model.width=-1 (failed)" in err.splitlines()[-1]
    row = table(root).pop("model.width=-1")
    assert row["status"] == "failed" and "at least 1" in row["diagnosis"] and row["psnr"] == ""
    assert sum(row["status"] != "failed" for row in table(root).values()) == 1
    assert "Traceback" in (root / "model.width=-1" / "error.txt").read_text()
    assert json.loads((root / "model.width=-1" / "results.json").read_text())["seed"] == 0
    code, out, err = run_cli("-m", *SMALL, *BARE, "model.width=-1,8")
    assert code == 1 and out.count("done before") == 1, "what failed is tried again"
    assert (root / "model.width=-1" / "error.txt").is_file()


def test_sweep_interrupted_continues_and_keeps_a_job_of_other_options(run_cli, tmp_path: Path, monkeypatch):
    from nerf_lightning.callbacks import ProgressBar

    def stop(self, trainer, *given):
        if trainer.global_step == 2 and trainer.lightning_module.seed == 1:
            signal.raise_signal(signal.SIGTERM)

    line = ["-m", *SMALL, *BARE, "model.width=8", "seed=0,1"]
    with monkeypatch.context() as patch:
        patch.setattr(ProgressBar, "on_train_batch_end", stop)
        code, out, err = run_cli(*line)
    assert code == 143 and err.splitlines()[-1] == "nerf_lightning: interrupted (SIGTERM); the same command continues"
    (root,) = (tmp_path / "outputs" / "smoke_2d").iterdir()
    rows = table(root)
    assert rows["seed=1"]["status"] == "interrupted" and "step 2" in rows["seed=1"]["diagnosis"]
    code, out, err = run_cli(*line)
    assert code == 0 and "seed=0: done before" in out and "seed=1: continues from its last checkpoint" in out, err
    assert "interrupted" not in {row["status"] for row in table(root).values()}
    job = root / "seed=1"
    (job / "config.yaml").write_text((job / "config.yaml").read_text().replace("lr: 0.01", "lr: 0.02"))
    results = (job / "results.json").read_bytes()
    code, out, err = run_cli(*line)
    assert code == 1 and "seed=1: starts" not in out and "1 of 2 jobs are not done: seed=1" in err
    assert "seed=1: failed" in err and "overwrite=true" in err
    assert (job / "results.json").read_bytes() == results, "nothing is lost without being asked"
    code, out, err = run_cli(*line, "overwrite=true")
    assert code == 0 and "seed=0: done before" in out and "seed=1: starts" in out
    assert not (job / "error.txt").exists()


def test_sweep_skips_job_locked_by_other_process(run_cli, tmp_path: Path):
    job = tmp_path / "sweep" / "seed=1"
    given = ["-m", *SMALL, *BARE, "callbacks.snapshots.steps=[]", "logger=null", f"hydra.sweep.dir={tmp_path}/sweep"]
    with lock_folder(job):
        (job / "config.yaml").write_text("seed: 1")
        code, out, err = run_cli(*given, "seed=0,1")
        assert "seed=0: starts" in out and "seed=1: starts" not in out
        assert code == 1 and "1 of 2 jobs are not done: seed=1 (unfinished)" in err and "in progress" in err
        assert sorted(path.name for path in job.iterdir()) == [".lock", ".nerf_lightning", "config.yaml"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["seed=0,1", "foo=1"], "foo"),
        (["model=null,siren"], "model: found null, expected one of fourier"),
        (["seed=0,1", "hydra/launcher=submitit_lunar"], "nerf_lightning[sweeps]"),
    ],
)
def test_sweep_bad_input_exits_with_code_2(arguments: list[str], words: str, run_cli, tmp_path: Path):
    code, _, err = run_cli("-m", *SMALL, *arguments)
    assert code == 2 and words in err and err.count("\n") == 1 and not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("ignore")  # Optuna warns, and here warnings are errors
def test_sweep_by_optuna_repeats_its_trials_and_records_failures(run_cli, tmp_path: Path, capfd):
    line = ["+experiment=tune_picture", "dataset.max_side=16", "budget.steps=2", "hydra.sweeper.n_trials=2", *BARE]
    outputs = [run_cli(*line), run_cli(*line)]
    assert [code for code, _, _ in outputs] == [0, 0], outputs
    assert [out.count(": starts") for _, out, _ in outputs] == [2, 0]
    assert [out.count("done before") for _, out, _ in outputs] == [0, 2]
    with pytest.raises(ValueError, match="No trials are completed"):
        run_cli(*line, "model.base_resolution=0")
    out, err = capfd.readouterr()
    assert out.count(": starts") == 2 and err.count("failed: config: model.base_resolution") == 2
    assert {len(table(path)) for path in (tmp_path / "outputs" / "tune_picture").iterdir()} == {2}


@pytest.mark.long
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_sweep_other_launchers_finish(launcher: str, tmp_path: Path):
    """Launchers that run jobs in other processes, which must import this package."""
    settings, jobs = {
        "joblib": (["model.width=8,-1", "hydra.launcher.n_jobs=2"], 2),
        "submitit_local": (["+model.lr_scale=-1", "seed=0", "threads=1"], 1),  # each job is a process
    }[launcher]
    done = run_process("-m", *SMALL, *BARE, f"hydra/launcher={launcher}", *settings, cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    assert f"1 of {jobs} jobs are not done: " in done.stderr
    (root,) = (tmp_path / "outputs" / "smoke_2d").iterdir()
    statuses = [row["status"] for row in table(root).values()]
    assert statuses.count("failed") == 1 and statuses.count("unfinished") == 0


def test_train_two_processes_write_one_folder(run_cli, tmp_path: Path):
    """Of planes that grow."""
    options = [
        *("dataset.size=24", "dataset.train_views=8", "dataset.val_views=1", "dataset.samples=1000", "model=tensorf"),
        *("model.size=fixed", "model.base_resolution=8", "model.max_resolution=16", "model.stages=2", "threads=1"),
        *("sampler.resolution=16", "callbacks.orbit=null", "callbacks.snapshots.steps=[]", "trainer.accelerator=cpu"),
        "budget.steps=200",  # after 100 of so small a scene, seeds alone differ by 1.2 dB
    ]
    code, out, err = run_cli(*options, "name=one")
    assert code == 0, err
    done = run_process(*options, "trainer=ddp", "name=two", cwd=tmp_path)
    assert done.returncode == 0 and not re.search(r"\.py:\d+: ", done.stderr), done.stderr  # no library has remarks
    results = []
    for name, output in (("one", out), ("two", done.stdout)):
        folder = tmp_path / "outputs" / name / "latest"
        results.append(json.loads((folder / "results.json").read_text()))
        assert len(list(folder.rglob("results.json"))) == 1
        assert (folder / "checkpoints" / "last.ckpt").stat().st_size > 0
        assert output.count("everything is in") == 1
    one, two = results
    assert abs(one["psnr"] - two["psnr"]) < 1.0 and one["psnr"] > 15
    assert (two["steps"], two["status"]) == (200, "finished")


def test_sweep_multi_process_jobs_raise(run_cli):
    pair = ["trainer=ddp", "trainer.accelerator=cpu"]
    code, out, err = run_cli("-m", *SMALL, "seed=0,1", *pair)
    assert code == 1 and err.count("one process a job in a sweep") >= 2
