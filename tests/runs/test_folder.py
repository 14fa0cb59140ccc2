"""A run folder is read back without trusting it: damage gets one line, and nothing in it is executed."""

import functools
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml

from nerf_lightning.errors import InputError
from nerf_lightning.runs.checkpoint import RESUME_KEYS, read_checkpoint
from nerf_lightning.runs.folder import (
    SWEEP_CALLBACK,
    TRUSTED_PACKAGES_VARIABLE,
    list_shipped_targets,
    load_config,
    load_run,
)


@pytest.fixture
def config(small_run: Path) -> dict:
    return yaml.safe_load((small_run / "config.yaml").read_text(encoding="utf-8"))


def write(config: object, folder: Path) -> Path:
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


def test_load_config_accepts_shipped_targets(config: dict, tmp_path: Path):
    assert len(list_shipped_targets()) > 25 and SWEEP_CALLBACK not in list_shipped_targets()
    for target in list_shipped_targets():
        config["callbacks"]["orbit"] = {"_target_": target}
        assert load_config(write(config, tmp_path)).callbacks.orbit._target_ == target


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "nerf_lightning.utils.files.os.system",  # reachable through the package, but not of it
        "nerf_lightning.dataset.save_npz",  # of the package, but writes to any path
        "nerf_lightning.training.sweep.SweepReport",
        ["nerf_lightning.callbacks.Orbit"],
    ],
)
def test_load_config_rejects_untrusted_targets(target: object, config: dict, tmp_path: Path):
    config["callbacks"]["orbit"] = {"nested": [{"_target_": target}]}
    with pytest.raises(InputError, match=r"callbacks\.orbit\.nested\[0\]\._target_.*a class of this package"):
        load_config(write(config, tmp_path))


def test_load_config_accepts_trusted_packages(config: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config["model"] = {"_target_": "decimal.Decimal"}
    with pytest.raises(InputError, match=TRUSTED_PACKAGES_VARIABLE):
        load_config(write(config, tmp_path))
    monkeypatch.setenv(TRUSTED_PACKAGES_VARIABLE, "decimal")
    assert load_config(tmp_path).model._target_ == "decimal.Decimal"


def test_load_config_does_not_interpolate(config: dict, tmp_path: Path):
    """A path may hold such text; a stranger's must not read the environment."""
    config["dataset"]["path"] = "${oc.env:HOME}"
    assert load_config(write(config, tmp_path)).dataset.path == "${oc.env:HOME}"


class Payload:
    """Pickled, it makes a file when it is read carelessly."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def change(**values: object) -> Callable[[Path], object]:
    """Replaces values at dotted keys (with __) of a JSON or YAML file; None removes a key."""

    def apply(path: Path) -> None:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        for key, value in values.items():
            *groups, last = key.split("__")
            node = content
            for group in groups:
                node = node[group]
            node.pop(last) if value is None else node.update({last: value})
        path.write_text(json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content), encoding="utf-8")

    return apply


def flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1  # in the weights
    path.write_bytes(content)


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def cut_before_schedule(path: Path) -> None:
    path.write_text(path.read_text(encoding="utf-8").partition("schedule:")[0], encoding="utf-8")


def with_nan(path: Path) -> None:
    state = torch.load(path, weights_only=True)
    next(iter(state["state_dict"].values())).fill_(torch.nan)
    torch.save(state, path)


def save(make: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda path: torch.save(make(path), path)


CONFIG, SCENE, CHECKPOINT = "config.yaml", "scene.json", "checkpoints/last.ckpt"
DAMAGES: list[tuple[str, Callable[[Path], object], str]] = [
    (CONFIG, Path.unlink, "no such file"),
    (CONFIG, cut_before_schedule, "missing"),
    (CONFIG, lambda path: path.write_text(f"!!python/object/apply:os.mkdir ['{path.parent}/run']"), "unreadable as"),
    (CONFIG, change(version="9.9"), "version 9.9"),
    (CONFIG, change(dataset="lego"), "options by name"),
    (CONFIG, change(model__finest=functools.reduce(lambda x, _: [x], range(150), 1)), "nested too deep"),
    (CONFIG, change(model__hue=3), "unknown option"),
    (SCENE, Path.unlink, "no such file"),
    (SCENE, cut, "unreadable as"),
    (SCENE, change(orbit=None), "KeyError"),
    (SCENE, change(orbit__width=10**6, orbit__height=10**6), "pixels"),
    (SCENE, change(aabb=[[0, 0, 0], [1, 1, float("nan")]]), "nan"),
    (CHECKPOINT, Path.unlink, "no such file"),
    (CHECKPOINT, cut, "no checkpoint"),
    (CHECKPOINT, flip_bit, "its checksum differs"),
    (CHECKPOINT, save(lambda path: {"state_dict": Payload(path.parent / "run")}), "no checkpoint"),
    (CHECKPOINT, save(lambda path: {"state_dict": {}}), "state_dict"),
    (CHECKPOINT, lambda path: change(model__width=128)(path.parents[1] / CONFIG), "this run's model"),
    (CHECKPOINT, with_nan, "not finite"),
]


@pytest.mark.parametrize(("name", "damage", "word"), DAMAGES)
def test_load_run_damaged_file_raises_without_executing(
    name: str, damage: Callable[[Path], object], word: str, small_run: Path, tmp_path: Path
):
    folder = Path(shutil.copytree(small_run, tmp_path / "copy"))
    damage(folder / name)
    with pytest.raises(InputError) as error:
        load_run(folder)
    line = str(error.value)
    assert word in line and str(folder / name) in line and "\n" not in line and len(line) < 1500
    assert not list(tmp_path.rglob("run")), "a payload has run"


def test_read_checkpoint_to_resume_needs_more_than_weights(small_run: Path, tmp_path: Path):
    read_checkpoint(small_run / CHECKPOINT, RESUME_KEYS)
    torch.save({"state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=r"a\.ckpt: loops"):
        read_checkpoint(tmp_path / "a.ckpt", RESUME_KEYS)


def test_resume_checkpoint_of_other_run_raises(small_run: Path, run_cli, tmp_path: Path):
    folder = Path(shutil.copytree(small_run, tmp_path / "run"))
    state = torch.load(folder / CHECKPOINT, weights_only=True)
    state["optimizer_states"] = [{"state": {}, "param_groups": []}]
    torch.save(state, folder / CHECKPOINT)
    before = {path: path.read_bytes() for path in folder.glob("*.json")}
    code, _, err = run_cli(f"resume={folder}", "budget.steps=12")
    assert code == 2 and err.count("\n") == 1 and "cannot be resumed" in err, err
    assert {path: path.read_bytes() for path in folder.glob("*.json")} == before
