"""Loggers: each gets the training metrics, the options and the final metrics."""

import csv
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import yaml

from nerf_lightning.training import loggers

SMALL = ("+experiment=smoke_2d", "dataset.max_side=16", "budget.steps=3", "callbacks=null", "hydra.run.dir=run")


def test_tensorboard_run_is_one_file_with_curves(run_cli, tmp_path: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    small = [word for word in SMALL if word != "callbacks=null"]
    quick = ("callbacks.throughput.every=1", "callbacks.pictures=null", "seed=3")
    code, _, err = run_cli(*small, *quick)
    assert code == 0, err
    results = json.loads((tmp_path / "run" / "results.json").read_text(encoding="utf-8"))
    (file,) = (tmp_path / "run").glob("events.out.tfevents.*")
    assert not (tmp_path / "run" / "hparams.yaml").exists()
    events = EventAccumulator(str(file)).Reload()
    assert [event.step for event in events.Scalars("loss/photometric")] == [1, 2, 3]
    last = events.Scalars("val/psnr")[-1]
    assert (last.step, last.value) == (3, pytest.approx(results["psnr"], abs=1e-3))
    dated = last.wall_time - events.Scalars("speed/train_seconds")[0].wall_time
    passed = results["train_seconds"] - events.Scalars("speed/train_seconds")[0].value
    assert dated == pytest.approx(passed, abs=0.01), "dates are seconds of training"
    assert not [name for name in events.Tags()["scalars"] if name.startswith(("final", "hp", "test"))]
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    values = HParamsPluginData.FromString(content).session_start_info.hparams
    assert set(values) == {"method", "recipe", "seed", "bytes"}
    assert values["method"].string_value == "picture_mlp" and values["bytes"].number_value == results["artifact_bytes"]


def test_csv_logger_writes_metrics(run_cli, tmp_path: Path):
    code, out, err = run_cli(*SMALL, "logger=csv", "seed=3")
    assert code == 0 and "tensorboard" not in out, err
    results = json.loads((tmp_path / "run" / "results.json").read_text(encoding="utf-8"))
    folder = tmp_path / "run" / "csv" / "version_0"
    with (folder / "metrics.csv").open(encoding="utf-8") as file:
        figures = {key: float(value) for row in csv.DictReader(file) for key, value in row.items() if value}
    assert [figures["val/psnr"], figures["final/psnr"]] == pytest.approx([results["psnr"]] * 2, abs=1e-4)
    assert yaml.safe_load((folder / "hparams.yaml").read_text(encoding="utf-8"))["seed"] == 3


@pytest.mark.parametrize("extra", ["wandb", "mlflow"])
def test_logger_missing_package_raises(extra: str, run_cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, extra, None)
    code, _, err = run_cli(*SMALL, f"logger={extra}")
    assert code == 2 and err.count("\n") == 1 and f"pip install 'nerf_lightning[{extra}]', or logger=csv" in err
    assert not list(tmp_path.iterdir())


def test_finish_wandb_ends_run_of_each_training(monkeypatch: pytest.MonkeyPatch):
    finished: list[str] = []
    module = ModuleType("wandb")
    module.run = own = SimpleNamespace(finish=lambda: finished.append("the user's"))
    monkeypatch.setitem(sys.modules, "wandb", module)
    with loggers.finish_wandb():
        pass
    assert module.run is own and finished == []
    with pytest.raises(RuntimeError), loggers.finish_wandb():
        module.run = SimpleNamespace(finish=lambda: finished.append("training's"))
        raise RuntimeError
    assert finished == ["training's"]
