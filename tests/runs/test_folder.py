"""A run folder is read back without trusting it."""

import json
import math
import pickle
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml

from nerf_lightning.errors import InputError
from nerf_lightning.runs.checkpoint import RESUMED, read_checkpoint
from nerf_lightning.runs.folder import load_config, load_run, system_of
from nerf_lightning.runs.scene_file import frame_from, load_scene
from nerf_lightning.runs.trusted import TARGETS, TRUST
from nerf_lightning.utils.device import CPU


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


def test_nothing_is_interpolated(config: dict, tmp_path: Path):
    """A path may hold such text; a stranger's must not read the environment."""
    config["dataset"]["path"] = "${oc.env:HOME}"
    assert load_config(written(config, tmp_path)).dataset.path == "${oc.env:HOME}"
    config["dataset"]["path"] = "???"
    with pytest.raises(InputError, match=r"dataset\.path.*a resolved value"):
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


def changed(**values: object) -> Callable[[Path], object]:
    """A run's JSON or YAML file with some values replaced; None at a dotted key removes it."""

    def apply(path: Path) -> None:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        for key, value in values.items():
            *groups, last = key.split("__")
            node = content
            for group in groups:
                node = node[group]
            node.pop(last) if value is None else node.update({last: value})
        text = json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content)
        path.write_text(text, encoding="utf-8")

    return apply


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1  # in the weights
    path.write_bytes(content)


def weights(change: Callable[[dict[str, torch.Tensor]], object]) -> Callable[[Path], object]:
    def apply(path: Path) -> None:
        state = torch.load(path, weights_only=True)
        change(state["state_dict"])
        torch.save(state, path)

    return apply


HUGE = torch.zeros(1).expand(10**5, 10**5)
DAMAGES: list[tuple[str, Callable[[Path], object], str]] = [
    ("config.yaml", lambda p: p.write_text("[" * 5000), "config.yaml: found no YAML (more than"),
    ("config.yaml", changed(seed=None), "config.yaml: seed: found nothing"),
    ("config.yaml", changed(seed=-1), "config.yaml: seed: found -1"),
    ("config.yaml", changed(kernels=None), "config.yaml: kernels: found nothing"),
    ("config.yaml", changed(name=[0] * 9000), "config.yaml: found 9,1"),
    ("config.yaml", changed(model=3), "config.yaml: model: found"),
    ("config.yaml", changed(model__width="???"), "config.yaml: model.width: found '???'"),
    ("config.yaml", changed(model__width=10**9), "config.yaml: model: found numbers, with the copy"),
    ("config.yaml", changed(sampler__resolution=10**5), "config.yaml: sampler: found numbers, with the copy"),
    ("config.yaml", changed(sampler__resolution=10**8), "config.yaml: sampler.resolution: found 100000000"),
    ("config.yaml", changed(sampler__early_stop_eps=2), "config.yaml: sampler.early_stop_eps: found 2"),
    ("config.yaml", changed(optimizer__betas=[]), "config.yaml: optimizer: found"),
    ("scene.json", lambda p: p.write_text("[]"), "scene.json: found a list"),
    (
        "scene.json",
        changed(orbit__width=10**6, orbit__height=10**6),
        "scene.json: orbit: found 1000000x1000000 pixels that take at least",
    ),
    ("scene.json", changed(orbit__width=1.5), "scene.json: orbit: found 1.5"),
    ("scene.json", changed(orbit__c2w=[]), "scene.json: orbit.c2w: found"),
    ("scene.json", changed(orbit=[]), "scene.json: orbit: found []"),
    ("scene.json", changed(aabb=[]), "scene.json: aabb: found shape (0,)"),
    ("scene.json", changed(aabb=[[0, 0, 0], [1, 1, math.nan]]), "scene.json: aabb: found nan"),
    ("scene.json", changed(near="close"), "scene.json: near: found 'close'"),
    ("scene.json", changed(unbounded=1), "scene.json: unbounded: found 1"),
    ("scene.json", changed(background=[1, 1]), "scene.json: background: found shape (2,)"),
    ("scene.json", changed(to_source=[[0] * 4] * 4), "scene.json: to_source: found a scale"),
    (
        "scene.json",
        changed(to_source=[[1, 1.7e308, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        "scene.json: to_source: found",
    ),
    ("scene.json", changed(name=3), "scene.json: name: found 3"),
    ("checkpoints/last.ckpt", lambda p: p.write_text("text"), "last.ckpt: found File is not a zip file"),
    ("checkpoints/last.ckpt", lambda p: torch.save([1], p), "last.ckpt: found a list"),
    ("checkpoints/last.ckpt", lambda p: torch.save({"state_dict": [1]}, p), "last.ckpt: state_dict: found a list"),
    ("checkpoints/last.ckpt", flipped, "found other bytes than were written"),
    (
        "checkpoints/last.ckpt",
        weights(lambda state: next(iter(state.values())).fill_(math.nan)),
        "found nan or infinity",
    ),
    (
        "checkpoints/last.ckpt",
        weights(lambda state: state.update(x=HUGE)),
        "state_dict.x: found Tensor, expected a tensor with",
    ),
    (
        "checkpoints/last.ckpt",
        weights(lambda state: state.update(x=1)),
        "state_dict.x: found int, expected a tensor with",
    ),
]


@pytest.mark.parametrize(("name", "damage", "words"), DAMAGES, ids=[words for _, _, words in DAMAGES])
def test_a_damaged_file_of_a_run_is_named(
    name: str, damage: Callable[[Path], object], words: str, small_run: Path, tmp_path: Path
):
    shutil.copytree(small_run, tmp_path / "run")
    damage(tmp_path / "run" / name)
    with pytest.raises(InputError) as error:
        load_run(tmp_path / "run")
    assert words in str(error.value) and str(tmp_path / "run" / name) in str(error.value)
    assert "\n" not in str(error.value) and len(str(error.value)) < 1500


def test_weights_are_counted_without_drawing_a_number(small_run: Path):
    cfg, scene = load_config(small_run), load_scene(small_run)
    before = torch.get_rng_state()
    with torch.device("meta"):
        system_of(cfg, frame_from(scene, "scene.json")[0], CPU, "config.yaml")
    assert torch.equal(torch.get_rng_state(), before)


def test_a_checkpoint_to_go_on_from_holds_more_than_weights(small_run: Path, tmp_path: Path):
    read_checkpoint(small_run / "checkpoints" / "last.ckpt", RESUMED)
    torch.save({"state_dict": {}, "loops": {}, "callbacks": []}, tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=r"a\.ckpt: callbacks: found a list, expected a dict"):
        read_checkpoint(tmp_path / "a.ckpt", RESUMED)
    state = torch.load(small_run / "checkpoints" / "last.ckpt", weights_only=True)
    loop = state["loops"]["fit_loop"]
    for where, key in (
        (loop["epoch_progress"]["total"], "ready"),
        (loop["epoch_loop.state_dict"], "_batches_that_stepped"),
    ):
        for nothing in (None, [], "1", -1, {"a": 1}, 10**400):
            right, where[key] = where[key], nothing
            torch.save(state, tmp_path / "b.ckpt")
            where[key] = right
            with pytest.raises(InputError, match=r"b\.ckpt: loops: found something else, expected counts of steps"):
                read_checkpoint(tmp_path / "b.ckpt", RESUMED)
    for where, key in ((state["callbacks"], "Budget"), (state, "RayDataModule")):
        right, where[key] = where[key], torch.zeros(2, 2)
        torch.save(state, tmp_path / "c.ckpt")
        with pytest.raises(InputError, match=rf"c\.ckpt: {key}: found a tensor, expected plain values by name"):
            read_checkpoint(tmp_path / "c.ckpt")
        where[key] = right


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
