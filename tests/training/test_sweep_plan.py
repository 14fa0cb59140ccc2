"""How far a sweep is and how long it will take."""

import json
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config import cli
from nerf_lightning.training import sweep_plan
from nerf_lightning.training.sweep_plan import PlannedJob, SweepProgress, planned


def swept(*overrides: str) -> DictConfig:
    """The configuration that a sweep's callback gets, in a sweep's mode."""
    fixed = [one for one in overrides if "," not in one]
    with initialize_config_dir(str(cli.conf_dir()), version_base="1.3"):
        cfg = compose("config", fixed, return_hydra_config=True)
    OmegaConf.set_readonly(cfg, False)
    OmegaConf.update(cfg, "hydra.overrides.task", list(overrides), force_add=True)
    HydraConfig.instance().set_config(cfg)
    return cfg


def test_the_plan_is_the_product_in_the_order_of_the_jobs():
    jobs = planned(swept("dataset.size=24", "seed=0,1", "budget.seconds=5,60"))
    assert jobs == [
        PlannedJob("budget.seconds=5,seed=0", 5.0),
        PlannedJob("budget.seconds=60,seed=0", 60.0),
        PlannedJob("budget.seconds=5,seed=1", 5.0),
        PlannedJob("budget.seconds=60,seed=1", 60.0),
    ]


def test_a_presets_own_values_come_first():
    jobs = planned(swept("+experiment=pareto", "dataset.path=x.npz"))
    assert len(jobs) == 108
    assert jobs[0] == PlannedJob("budget.seconds=5,recipe=mlp_small,seed=0", 5.0)
    assert jobs[-1].seconds == 60.0
    assert len({job.folder for job in jobs}) == 108


@pytest.mark.parametrize(
    ("overrides", "seconds"),
    [
        (["seed=0,1"], 90.0),
        (["seed=0,1", "budget.steps=100"], None),
        (["budget.steps=100,200"], None),
        (["budget.steps=100,200", "budget.seconds=7"], 7.0),
        (["+experiment=lego_mlp", "seed=0,1"], None),
    ],
)
def test_what_ends_a_job(overrides: list[str], seconds: float | None):
    assert [job.seconds for job in planned(swept(*overrides))] == [seconds, seconds]


def test_sweeps_that_think_on_the_way_or_run_side_by_side_have_no_plan():
    assert planned(swept("+experiment=tune_picture")) == []
    assert planned(swept("hydra/launcher=joblib", "seed=0,1")) == []


def test_time_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(sweep_plan.time, "monotonic", lambda: now[0])

    def finish(name: str, status: str = "finished") -> None:
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps({"status": status}))

    finish("b")
    jobs = [PlannedJob("a", 10.0), PlannedJob("b", 10.0), PlannedJob("c", 60.0), PlannedJob("d", 60.0)]
    progress = SweepProgress(tmp_path, jobs)
    assert progress.begin(0) == "job 1 of 4", "nothing is known yet"
    now[0] = 6.0
    assert progress.seconds_left(8.0) == 8 + 2 * (60 + 4), "b was done before; 4 seconds beside training each"
    now[0] = 14.0
    finish("a")
    progress.end(0)
    progress.begin(1)
    progress.end(1)
    assert progress.begin(2) == "job 3 of 4, about 2:08 left"
    now[0] = 15.0
    assert progress.seconds_left(65.0) == 65 + 60 + 5, "this job seems to take 6 seconds beside training: 5 on average"
    finish("c", "failed")
    progress.end(2)
    assert progress.begin(3) == "job 4 of 4, about 1:04 left", "a failed job says nothing about time"
    steps = SweepProgress(tmp_path, [PlannedJob("e", None), PlannedJob("f", None)])
    assert steps.begin(0) == "job 1 of 2"
    now[0] = 40.0
    assert steps.seconds_left(5.0) == 35, "both take 30 seconds"
    finish("e")
    steps.end(0)
    assert steps.begin(1) == "job 2 of 2, about 0:25 left"
