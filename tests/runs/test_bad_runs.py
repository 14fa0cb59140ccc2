"""Run folders missing, half-written, of another version or a stranger's: one line from every verb, and nothing executed."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from nerf_lightning.config import cli
from nerf_lightning.evaluate.__main__ import task as evaluate
from nerf_lightning.export.__main__ import task as export
from nerf_lightning.render.__main__ import task as render
from nerf_lightning.view.__main__ import task as view

VERBS: dict[str, tuple[Callable[..., object], list[str]]] = {
    "render": (render, ["frames=1"]),
    "view": (view, ["port=0"]),
    "evaluate": (evaluate, []),
    "compact": (export, []),
    "mesh": (export, ["format=ply"]),
}
CONFIGS = {"compact": "export", "mesh": "export"}


class Marker:
    """Pickled, it makes a file when it is read carelessly."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def nothing(run: Path) -> None:
    shutil.rmtree(run)


def no_configuration(run: Path) -> None:
    (run / "config.yaml").unlink()


def half_a_configuration(run: Path) -> None:
    (run / "config.yaml").write_text((run / "config.yaml").read_text()[:700] + "\n  : [")


def a_configuration_cut_between_groups(run: Path) -> None:
    whole = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(whole[: whole.index("schedule:")])


def text_for_a_group(run: Path) -> None:
    config = yaml.safe_load((run / "config.yaml").read_text())
    (run / "config.yaml").write_text(yaml.safe_dump({**config, "dataset": "lego"}))


def no_scene(run: Path) -> None:
    (run / "scene.json").unlink()


def half_a_scene(run: Path) -> None:
    (run / "scene.json").write_text((run / "scene.json").read_text()[:300])


def a_list_for_a_scene(run: Path) -> None:
    (run / "scene.json").write_text("[]")


def no_checkpoint(run: Path) -> None:
    (run / "checkpoints" / "last.ckpt").unlink()


def half_a_checkpoint(run: Path) -> None:
    path = run / "checkpoints" / "last.ckpt"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def a_later_format(run: Path) -> None:
    scene = json.loads((run / "scene.json").read_text())
    (run / "scene.json").write_text(json.dumps({**scene, "format": 99}))


def another_model(run: Path) -> None:
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["model"]["width"] *= 2
    (run / "config.yaml").write_text(yaml.safe_dump(config))


def an_option_of_another_version(run: Path) -> None:
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["model"]["hue"] = 3
    (run / "config.yaml").write_text(yaml.safe_dump(config))


def an_option_that_is_no_number(run: Path) -> None:
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["logger"] = [0, float("nan")]
    (run / "config.yaml").write_text(yaml.safe_dump(config))


def a_strangers_target(run: Path) -> None:
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["model"] = {"_target_": "pathlib.Path.touch", "_args_": [str(run.parent / "executed")]}
    (run / "config.yaml").write_text(yaml.safe_dump(config))


def a_strangers_yaml(run: Path) -> None:
    (run / "config.yaml").write_text(f"model: !!python/object/apply:os.mkdir ['{run.parent}/executed']\n")


def a_strangers_checkpoint(run: Path) -> None:
    torch.save({"state_dict": Marker(run.parent / "executed")}, run / "checkpoints" / "last.ckpt")


DAMAGES: dict[Callable[[Path], None], str] = {
    nothing: "config.yaml: found nothing there, expected the folder of a run",
    no_configuration: "config.yaml: found nothing there",
    half_a_configuration: "expected a run's configuration in YAML",
    a_configuration_cut_between_groups: "config.yaml: schedule: found nothing, expected a run's whole configuration",
    text_for_a_group: "config.yaml: dataset: found 'lego', expected a run's whole configuration",
    no_scene: "scene.json: found nothing there, expected the scene of a run",
    half_a_scene: "expected the scene of a run, whole",
    a_list_for_a_scene: "expected the scene of a run, whole",
    no_checkpoint: "last.ckpt: found nothing there, expected a checkpoint; the run may have ended before its first one",
    half_a_checkpoint: "expected a whole checkpoint of tensors and plain values",
    a_later_format: "found format 99, expected format 1, which this version reads",
    another_model: "expected the weights of this run's model",
    an_option_of_another_version: "model.hue: found an unknown option",
    an_option_that_is_no_number: "config.yaml: logger[1]: found nan, expected a finite number",
    a_strangers_target: "model._target_: found 'pathlib.Path.touch', expected a class of this package",
    a_strangers_yaml: "expected a run's configuration in YAML",
    a_strangers_checkpoint: "expected a whole checkpoint of tensors and plain values",
}


BY_ALL = (nothing, a_strangers_target, a_strangers_yaml, a_strangers_checkpoint)
"""Met by every verb; as all verbs open runs with the same code, one is enough for the others."""


@pytest.mark.parametrize(
    ("verb", "damage"), [(verb, one) for one in DAMAGES for verb in (VERBS if one in BY_ALL else ["render"])]
)
def test_one_line_says_what_is_wrong_and_nothing_happens(
    verb: str,
    damage: Callable[[Path], None],
    small_run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
):
    run = tmp_path / "run"
    shutil.copytree(small_run, run)
    damage(run)
    before = sorted(tmp_path.rglob("*"))
    task, more = VERBS[verb]
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NERF_LIGHTNING_TRACEBACK", raising=False)
    monkeypatch.setattr(sys, "argv", [verb, "run=run", *more])
    with pytest.raises(SystemExit) as stop:
        cli.run(CONFIGS.get(verb, verb), task, texts=("run",))
    line = capfd.readouterr().err
    assert stop.value.code == 2 and line.count("\n") == 1 and DAMAGES[damage] in line, line
    assert sorted(tmp_path.rglob("*")) == before
