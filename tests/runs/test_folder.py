"""A run folder is read back without trusting it."""

import pickle
import re
import shutil
from pathlib import Path

import pytest
import torch
import yaml

from nerf_lightning.errors import InputError
from nerf_lightning.runs.checkpoint import read_checkpoint
from nerf_lightning.runs.folder import load_config, load_run
from nerf_lightning.runs.trusted import TARGETS, TRUST


@pytest.fixture
def config() -> dict:
    return {
        "dataset": {"_target_": "nerf_lightning.dataset.from_bricks", "size": 16},
        "model": {"_target_": "nerf_lightning.model.HashGridField"},
        "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True},
        "schedule": {"_target_": "nerf_lightning.system.constant"},
        "trainer": {"_target_": "lightning.Trainer"},
        "callbacks": {"orbit": {"_target_": "nerf_lightning.callbacks.Orbit"}},
    }


def written(config: object, folder: Path) -> Path:
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


def test_the_packages_own_targets_are_trusted(config: dict, tmp_path: Path):
    assert load_config(written(config, tmp_path)).dataset.size == 16


def test_all_that_configurations_name_is_trusted(config: dict, tmp_path: Path):
    conf = Path(__file__).resolve().parents[2] / "conf"
    named = {name for file in conf.rglob("*.yaml") for name in re.findall(r"_target_: ([\w.]+)", file.read_text())}
    assert len(named) > 25
    for target in named - {"nerf_lightning.training.sweep.SweepReport"}:  # Hydra's, never in a run's configuration
        config["callbacks"]["orbit"] = {"_target_": target}
        load_config(written(config, tmp_path))
    assert {f"{module}.{name}" for module, names in TARGETS.items() for name in names} <= named


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "subprocess.Popen",
        "nerf_lightning.utils.files.os.system",  # reachable through the package, but not of it
        "nerf_lightning.dataset.sources.shutil.rmtree",
        "nerf_lightning.dataset.no_such_thing",
        "nerf_lightning.dataset.save_npz",  # of the package, but writes wherever it is told to
        "nerf_lightning.dataset.sources._download",
        "nerf_lightning.dataset.sources.from_download",
        "nerf_lightning.training.train.train",
        "nerf_lightning.callbacks",
        "from_bricks",
        "nerf_lightning_evil.Thing",
        "torch.load",
        ["nerf_lightning.callbacks.Orbit"],
    ],
)
def test_other_targets_are_refused_wherever_they_stand(target: object, config: dict, tmp_path: Path):
    config["callbacks"]["orbit"] = {"nested": [{"_target_": target}]}
    with pytest.raises(InputError, match=r"callbacks\.orbit\.nested\[0\]\._target_.*a class of this package"):
        load_config(written(config, tmp_path))


def test_a_user_may_trust_another_package(config: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config["model"] = {"_target_": "decimal.Decimal"}
    with pytest.raises(InputError, match=TRUST):
        load_config(written(config, tmp_path))
    monkeypatch.setenv(TRUST, "decimal")
    assert load_config(tmp_path).model._target_ == "decimal.Decimal"


def test_interpolations_are_refused(config: dict, tmp_path: Path):
    config["dataset"]["size"] = "${oc.env:HOME}"
    with pytest.raises(InputError, match=r"dataset\.size.*a resolved value"):
        load_config(written(config, tmp_path))


@pytest.mark.parametrize("content", ["a: [", "- 1\n- 2", "!!python/object/apply:os.system ['true']", "\x00"])
def test_what_is_no_configuration_is_told_in_one_line(content: str, tmp_path: Path):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(InputError, match=r"config\.yaml") as error:
        load_config(tmp_path)
    assert "\n" not in str(error.value)


class _Code:
    def __reduce__(self):
        return (print, ("code ran",))


def test_a_checkpoint_never_runs_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "bad.ckpt"
    torch.save({"state_dict": _Code()}, path)
    with pytest.raises(InputError, match=r"bad\.ckpt.*tensors and plain values"):
        read_checkpoint(path)
    path.write_bytes(pickle.dumps(_Code(), protocol=2))
    with pytest.raises(InputError, match=r"bad\.ckpt"):
        read_checkpoint(path)
    assert "code ran" not in capsys.readouterr().out


def test_a_truncated_checkpoint_is_told(tmp_path: Path):
    torch.save({"state_dict": {"w": torch.zeros(1000)}}, tmp_path / "whole.ckpt")
    content = (tmp_path / "whole.ckpt").read_bytes()
    for size in (0, 10, len(content) // 2):
        (tmp_path / "cut.ckpt").write_bytes(content[:size])
        with pytest.raises(InputError, match=r"cut\.ckpt"):
            read_checkpoint(tmp_path / "cut.ckpt")


def test_damaged_run_folders_are_told(small_run: Path, tmp_path: Path):
    for name, damage, words in (
        ("scene.json", lambda p: p.unlink(), "scene.json: found nothing there, expected the scene of a run"),
        ("scene.json", lambda p: p.write_text("{"), "scene.json: found broken JSON at line 1"),
        (
            "scene.json",
            lambda p: p.write_text('{"aabb": [[0, 0, 0], [1, 1, 1]]}'),
            "scene.json: name: found no such key",
        ),
        ("checkpoints/last.ckpt", lambda p: p.unlink(), "last.ckpt: found nothing there"),
        ("checkpoints/last.ckpt", lambda p: torch.save({"state_dict": {}}, p), "last.ckpt: state_dict: found"),
    ):
        shutil.rmtree(tmp_path / "run", ignore_errors=True)
        shutil.copytree(small_run, tmp_path / "run")
        damage(tmp_path / "run" / name)
        with pytest.raises(InputError) as error:
            load_run(tmp_path / "run")
        assert words in str(error.value)
        assert "\n" not in str(error.value)
