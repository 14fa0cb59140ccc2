"""Text on command lines: every path is read as it is written."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from PIL import Image

from nerf_lightning.config.quoting import escape_interpolations, make_override, quote_overrides

NASTY = 'scan (1), ${x} #2 = "ü" [b]'
ODD = (
    *("a b", "[b]", "{a}", "a,b", "a=b", "#1", "a'b", "'a'", 'a"', "$a", "${a}", "${a", "a\\", "\\${a}", "日本"),
    *("2024", "true", "a;b&c", "~a", "choice(a,b)", NASTY),
)


def values_of(argument: str) -> list[object]:
    """Values of the key that an argument sets, by job, as Hydra and OmegaConf parse them."""
    parsed = OverridesParser.create().parse_override(argument)
    if not parsed.is_sweep_override():
        return [OmegaConf.create({"value": parsed.value()}).value]
    jobs = (OverridesParser.create().parse_override(f"key={one}") for one in parsed.sweep_string_iterator())
    return [OmegaConf.create({"value": job.value()}).value for job in jobs]


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SCANS", "scans (1)")


@pytest.mark.parametrize("text", ODD)
def test_quote_overrides_paths_stay_literal(text: str, tmp_path: Path):
    if "${" not in text and text not in ("'a'", "[b]"):
        assert values_of(*quote_overrides([f"hydra.run.dir={text}"], False)) == [text], "not there yet"
    (tmp_path / text).mkdir()
    for sweep in (False, True):
        assert values_of(*quote_overrides([f"dataset.path={text}"], sweep)) == [text]
    assert values_of(make_override("key", text)) == [text]
    assert OmegaConf.create(escape_interpolations({"a": [text]})).a[0] == text


@pytest.mark.parametrize(
    ("value", "sweep", "expected"),
    [
        ("null", False, [None]),
        ("'a, b'", False, ["a, b"]),
        ("[a,b]", False, [["a", "b"]]),
        ("${oc.env:SCANS}/ü, #2", False, ["scans (1)/ü, #2"]),
        ("a (1), 2024,${oc.env:SCANS}", True, ["a (1)", "2024", "scans (1)"]),
        ("both, together", True, ["both, together"]),
        ("'c,d','e'", True, ["c,d", "e"]),
        ("choice(a,b)", True, ["a", "b"]),
    ],
)
def test_quote_overrides_keeps_hydra_syntax(value: str, sweep: bool, expected: list[object], tmp_path: Path):
    (tmp_path / "both, together").mkdir()
    assert values_of(*quote_overrides([f"++dataset.path={value}"], sweep)) == expected


def test_quote_overrides_leaves_other_keys_unchanged():
    read = ["seed=1,2", "model.num_levels=[1,2]", "~logger", "-m", "--config-dir=a (1)", "budget.seconds=1e2"]
    assert quote_overrides(read, False) == read
    assert values_of(*quote_overrides(["+callbacks.own.file=a (1).txt"], False)) == ["a (1).txt"]


SMALL = ["+experiment=smoke_2d", "dataset.max_side=16", "callbacks=null", "budget.steps=2", "logger=null"]


def write_picture(folder: Path) -> Path:
    folder.mkdir(parents=True)
    Image.fromarray(np.arange(432, dtype=np.uint8).reshape(12, 12, 3)).save(folder / "photo, 1.png")
    return folder / "photo, 1.png"


def test_train_odd_path_names_resume_and_evaluate(run_cli, tmp_path: Path):
    """Trained, resumed on a picture that has moved, measured on a third."""
    picture = write_picture(tmp_path / NASTY)
    (tmp_path / f"run {NASTY}").mkdir()
    given = [f"dataset.path={NASTY}/{picture.name}", f"hydra.run.dir=run {NASTY}"]
    code, _, err = run_cli(*SMALL, "callbacks=picture", *given)
    assert code == 0, err
    run = tmp_path / f"run {NASTY}"
    saved = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
    assert saved["dataset"]["path"] == str(picture) and (run / "checkpoints" / "last.ckpt").exists()
    moved = picture.rename(tmp_path / "moved: ${y} 'é'.png")
    code, _, err = run_cli(f"resume=run {NASTY}", f"dataset.path={moved.name}", "budget.steps=4")
    assert code == 0, err
    saved = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
    assert saved["dataset"]["path"] == str(moved) and saved["budget"]["steps"] == 4
    assert '"steps": 4' in (run / "results.json").read_text(encoding="utf-8")
    picture = write_picture(tmp_path / "(2)")
    code, _, err = run_cli("evaluate", f"run {NASTY}", "--photos", f"(2)/{picture.name}")
    assert code == 0, err
    assert f"(2)/{picture.name}" in (run / "evaluation" / "views.json").read_text(encoding="utf-8")
