"""A run folder is read back without trusting it: damage gets one line, and nothing in it is executed."""

import json
import os
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml

from nerf_lightning.errors import InputError
from nerf_lightning.runs.checkpoint import RESUME_KEYS, read_checkpoint
from nerf_lightning.runs.folder import VERSION, load_config, load_run, system_of
from nerf_lightning.runs.scene_file import frame_from, load_scene
from nerf_lightning.runs.trusted import TARGETS, TRUST
from nerf_lightning.utils.device import CPU


@pytest.fixture
def config() -> dict:
    return {
        "version": VERSION,
        "dataset": {"_target_": "nerf_lightning.dataset.from_bricks", "size": 16},
        "model": {"_target_": "nerf_lightning.model.HashGridField"},
        "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True},
        "schedule": {"_target_": "nerf_lightning.system.constant"},
        "trainer": {"_target_": "lightning.Trainer"},
        "callbacks": {"orbit": {"_target_": "nerf_lightning.callbacks.Orbit"}},
    }


def write(config: object, folder: Path) -> Path:
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


def test_all_targets_of_conf_are_trusted_and_no_others(config: dict, tmp_path: Path):
    conf = Path(__file__).resolve().parents[2] / "conf"
    named = {name for file in conf.rglob("*.yaml") for name in re.findall(r"_target_: ([\w.]+)", file.read_text())}
    assert len(named) > 25
    for target in named - {"nerf_lightning.training.sweep.SweepReport"}:  # Hydra's, never in a run's configuration
        config["callbacks"]["orbit"] = {"_target_": target}
        assert load_config(write(config, tmp_path)).dataset.size == 16
    assert {f"{module}.{name}" for module, names in TARGETS.items() for name in names} <= named


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "nerf_lightning.utils.files.os.system",  # reachable through the package, but not of it
        "nerf_lightning.dataset.save_npz",  # of the package, but writes wherever it is told to
        "nerf_lightning.dataset.sources.from_download",
        "nerf_lightning.callbacks",
        "from_bricks",
        "nerf_lightning_evil.Thing",
        "torch.load",
        ["nerf_lightning.callbacks.Orbit"],
    ],
)
def test_other_targets_are_refused_anywhere(target: object, config: dict, tmp_path: Path):
    config["callbacks"]["orbit"] = {"nested": [{"_target_": target}]}
    with pytest.raises(InputError, match=r"callbacks\.orbit\.nested\[0\]\._target_.*a class of this package"):
        load_config(write(config, tmp_path))


def test_user_may_trust_another_package(config: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config["model"] = {"_target_": "decimal.Decimal"}
    with pytest.raises(InputError, match=TRUST):
        load_config(write(config, tmp_path))
    monkeypatch.setenv(TRUST, "decimal")
    assert load_config(tmp_path).model._target_ == "decimal.Decimal"


def test_load_config_interpolates_nothing(config: dict, tmp_path: Path):
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
    (CONFIG, Path.unlink, "nothing there"),
    (CONFIG, cut_before_schedule, "whole configuration"),
    (CONFIG, lambda path: path.write_text("[" * 5000), "no YAML"),
    (CONFIG, lambda path: path.write_text("- 1\n- 2"), "mapping"),
    (CONFIG, lambda path: path.write_text("\x00"), "no YAML"),
    (CONFIG, lambda path: path.write_text(f"!!python/object/apply:os.mkdir ['{path.parent}/run']"), "no YAML"),
    (CONFIG, change(version="9.9"), "version 9.9"),
    (CONFIG, change(version=None), "no version"),
    (CONFIG, change(dataset="lego"), "whole configuration"),
    (CONFIG, change(logger=[0, float("nan")]), "finite"),
    (CONFIG, change(model__hue=3), "unknown option"),
    (CONFIG, change(model__width="???"), "???"),
    (CONFIG, change(optimizer__betas=[]), "optimizer"),
    (SCENE, Path.unlink, "nothing there"),
    (SCENE, cut, "broken JSON"),
    (SCENE, lambda path: path.write_text("[]"), "list"),
    (SCENE, change(orbit=None), "KeyError"),
    (SCENE, change(orbit__width=10**6, orbit__height=10**6), "pixels"),
    (SCENE, change(orbit__c2w=[]), "c2w"),
    (SCENE, change(orbit=[]), "scene of a run"),
    (SCENE, change(aabb=[[0, 0, 0], [1, 1, float("nan")]]), "nan"),
    (SCENE, change(near="close"), "near"),
    (SCENE, change(background=[1, 1]), "background"),
    (SCENE, change(to_source=[[0] * 4] * 4), "to_source"),
    (CHECKPOINT, Path.unlink, "nothing there"),
    (CHECKPOINT, cut, "whole checkpoint"),
    (CHECKPOINT, flip_bit, "other bytes"),
    (CHECKPOINT, lambda path: path.write_text("text"), "whole checkpoint"),
    (CHECKPOINT, lambda path: path.write_bytes(pickle.dumps(Payload(path.parent / "run"), 2)), "whole checkpoint"),
    (CHECKPOINT, save(lambda path: {"state_dict": Payload(path.parent / "run")}), "whole checkpoint"),
    (CHECKPOINT, save(lambda path: [1]), "state_dict"),
    (CHECKPOINT, save(lambda path: {"state_dict": {}}), "state_dict"),
    (CHECKPOINT, save(lambda path: {"state_dict": [1]}), "state_dict"),
    (CHECKPOINT, with_nan, "nan or infinity"),
]


@pytest.mark.parametrize(("name", "damage", "word"), DAMAGES)
def test_load_run_names_the_damaged_file_and_runs_nothing(
    name: str, damage: Callable[[Path], object], word: str, small_run: Path, tmp_path: Path
):
    folder = Path(shutil.copytree(small_run, tmp_path / "copy"))
    damage(folder / name)
    with pytest.raises(InputError) as error:
        load_run(folder)
    line = str(error.value)
    assert word in line and str(folder / name) in line and "\n" not in line and len(line) < 1500
    assert not list(tmp_path.rglob("run")), "a payload has run"


def test_building_a_system_draws_no_random_number_on_meta(small_run: Path):
    cfg, scene = load_config(small_run), load_scene(small_run)
    before = torch.get_rng_state()
    with torch.device("meta"):
        system_of(cfg, frame_from(scene, "scene.json")[0], CPU, "config.yaml")
    assert torch.equal(torch.get_rng_state(), before)


def test_resuming_needs_more_than_weights(small_run: Path, tmp_path: Path):
    read_checkpoint(small_run / CHECKPOINT, RESUME_KEYS)
    torch.save({"state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=r"a\.ckpt: loops"):
        read_checkpoint(tmp_path / "a.ckpt", RESUME_KEYS)


def test_weights_of_another_model_are_refused(small_run: Path, tmp_path: Path):
    folder = Path(shutil.copytree(small_run, tmp_path / "run"))
    change(model__width=128)(folder / CONFIG)
    with pytest.raises(InputError, match="last.ckpt: state_dict"):
        load_run(folder)


@pytest.mark.parametrize("part", ["state_dict", "optimizer_states"])
def test_resuming_from_a_state_of_another_run_is_one_line(part: str, small_run: Path, inside, tmp_path: Path):
    folder = Path(shutil.copytree(small_run, tmp_path / "run"))
    state = torch.load(folder / CHECKPOINT, weights_only=True)
    state[part] = {} if part == "state_dict" else [{"state": {}, "param_groups": []}]
    torch.save(state, folder / CHECKPOINT)
    before = {path: path.read_bytes() for path in folder.glob("*.json")}
    code, _, err = inside(f"resume={folder}", "budget.steps=12")
    assert code == 2 and err.count("\n") == 1 and "a state of this run to continue from" in err, err
    assert {path: path.read_bytes() for path in folder.glob("*.json")} == before
