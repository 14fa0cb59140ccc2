"""The suite: which cells there are, what becomes of one, and what is made of all."""

import errno
import json
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import pytest

from nerf_lightning.config.compose import composed
from nerf_lightning.dataset import Picture
from nerf_lightning.errors import InputError
from nerf_lightning.stability.__main__ import stability
from nerf_lightning.stability.cell import Cell, Outcome, folder_of, run
from nerf_lightning.stability.conditions import CONDITIONS
from nerf_lightning.stability.methods import METHODS
from nerf_lightning.stability.report import markdown, summary, write_report
from nerf_lightning.stability.suite import QUICK, cells_of
from nerf_lightning.stability.verdict import passes, rescues, squares

PHOTOS = ["dataset=photos", "dataset.path=x"]
CONDITION = {condition.name: condition for condition in CONDITIONS}
GOOD = Outcome("clean", "hashgrid", 0, True, 30.0, "finished", "", 0, "")


def test_there_are_enough_conditions_and_each_says_what_must_be():
    assert len(CONDITIONS) >= 22 and len(CONDITION) == len(CONDITIONS)
    assert all(condition.check for condition in CONDITIONS)
    assert set(QUICK) <= set(CONDITION)


@pytest.mark.parametrize("condition", CONDITIONS, ids=lambda condition: condition.name)
def test_every_condition_has_a_scene_and_options_that_compose(condition, tmp_path: Path):
    assert isinstance(condition.scene(0), Picture) == condition.flat
    chosen = {m.kind: (m, condition.options_for(m.kind)) for m in METHODS.values() if m.flat == condition.flat}
    tried = {tuple(options): method for method, options in chosen.values() if options is not None}
    assert tried
    for options, method in tried.items():
        if options:  # the methods alone are composed below
            composed([*([] if method.flat else PHOTOS), *method.options, *options], tmp_path)


@pytest.mark.parametrize("name", METHODS)
def test_the_guard_is_off_where_a_method_says_so(name: str, tmp_path: Path):
    method = METHODS[name]
    cfg = composed([*([] if method.flat else PHOTOS), *method.options], tmp_path)
    assert cfg.callbacks.guard.attempts == (3 if method.guard else 0)


def test_cells():
    cells = cells_of(["clean", "OpenGL poses", "tiny hash table", "2D: clean"], ["hashgrid", "mlp", "2D mlp"], 2, 10)
    assert [(cell.condition, cell.method, cell.seed) for cell in cells] == [
        ("clean", "hashgrid", 0), ("clean", "hashgrid", 1), ("clean", "mlp", 0), ("clean", "mlp", 1),
        ("OpenGL poses", "hashgrid", 0), ("OpenGL poses", "mlp", 0),
        ("tiny hash table", "hashgrid", 0), ("tiny hash table", "hashgrid", 1),
        ("2D: clean", "2D mlp", 0), ("2D: clean", "2D mlp", 1),
    ]  # fmt: skip


@pytest.mark.parametrize("method", [name for name, method in METHODS.items() if method.guard and name != "relu mlp"])
def test_every_method_learns_something(method: str, tmp_path: Path):
    outcome = run(Cell("2D: clean" if METHODS[method].flat else "black, small object", method, 0, 30), tmp_path)
    assert outcome.status == "finished", outcome
    assert outcome.psnr is not None and outcome.psnr > 10


def test_a_cell_is_done_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    cell = Cell("OpenGL poses", "voxels", 0, 20)
    outcome = run(cell, tmp_path)
    assert outcome.status == "refused" and "axes of the other convention" in outcome.diagnosis
    assert str(tmp_path) not in outcome.diagnosis
    monkeypatch.setattr("nerf_lightning.stability.cell._train", lambda *_: pytest.fail("trained again"))
    assert run(cell, tmp_path) == outcome
    (cell.folder(tmp_path) / "cell.json").write_text('{"cell": ')
    with pytest.raises(pytest.fail.Exception):
        run(cell, tmp_path)
    with pytest.raises(pytest.fail.Exception):
        run(replace(cell, steps=21), tmp_path)


def test_a_full_disk_says_nothing_about_a_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    cell = Cell("2D: clean", "2D mlp", 0, 1)

    def full(cfg: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("nerf_lightning.training.train.train", full)
    with pytest.raises(OSError):
        run(cell, tmp_path)
    assert not (cell.folder(tmp_path) / "cell.json").exists()


def test_a_relu_network_dies_without_the_guard_and_lives_with_it(tmp_path: Path):
    """The control: of eight seeds this one ends at the colour of the background, where its density is zero for good."""
    lost = run(Cell("white, small object", "relu mlp, no guard", 7, 200), tmp_path)
    assert lost.status == "collapsed" and lost.recoveries == 0
    saved = run(Cell("white, small object", "relu mlp", 7, 200), tmp_path)
    assert saved.status == "finished" and saved.recoveries == 1
    assert saved.psnr is not None and lost.psnr is not None and saved.psnr > lost.psnr + 5


def test_a_rate_that_voxels_do_not_stand_is_lowered_before_the_first_step(tmp_path: Path):
    outcome = run(Cell("rate x10", "voxels", 0, 40), tmp_path)
    assert outcome.status == "finished" and outcome.recoveries == 1
    results = json.loads((Cell("rate x10", "voxels", 0, 40).folder(tmp_path) / "results.json").read_text())
    (one,) = results["recoveries"]
    assert one["step"] == 0 and "is too high for this field" in one["cause"]


def test_a_picture_of_one_colour_is_learned(tmp_path: Path):
    outcome = run(Cell("2D: one colour", "2D mlp", 0, 150), tmp_path)
    assert (outcome.status, outcome.diagnosis) == ("finished", "")
    assert outcome.psnr is not None and outcome.psnr > 40


def test_octaves_beyond_the_pixels_fail_between_them_and_it_is_told(tmp_path: Path):
    outcome = run(Cell("2D: L = 40", "2D mlp", 0, 150), tmp_path)
    assert outcome.status == "finished" and "between its pixels" in outcome.alarm
    assert outcome.psnr is not None and outcome.psnr < 15


@pytest.mark.parametrize(
    ("name", "outcome", "good"),
    [
        ("clean", GOOD, True),
        ("clean", replace(GOOD, status="collapsed"), False),
        ("clean", replace(GOOD, psnr=None, status="failed"), False),
        ("OpenGL poses", replace(GOOD, psnr=None, status="refused"), True),
        ("OpenGL poses", GOOD, False),
        ("shuffled poses", replace(GOOD, alarm="outlines that no body has"), True),
        ("clean", replace(GOOD, psnr=None, status="refused"), False),
        ("world x10", replace(GOOD, psnr=29.5), True),
        ("world x10", replace(GOOD, psnr=28.5), False),
    ],
)
def test_verdicts(name: str, outcome: Outcome, good: bool):
    assert passes(replace(outcome, condition=name), CONDITION[name], clean=30.0) == good


def test_the_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    outcomes = [replace(GOOD, seed=seed, psnr=30.0 - seed) for seed in range(3)]
    outcomes += [
        replace(GOOD, condition="white, small object", seed=seed, psnr=33.0, recoveries=1) for seed in range(2)
    ]
    bad = replace(GOOD, condition="white, small object", seed=2, psnr=18.0, status="collapsed", diagnosis="no density")
    outcomes += [bad, replace(GOOD, condition="OpenGL poses", psnr=None, status="refused", diagnosis="backs")]
    outcomes.append(replace(GOOD, condition="shuffled poses", psnr=16.0, alarm="outlines that no body has"))
    folder = folder_of(tmp_path, bad.condition, bad.method, bad.seed)
    folder.mkdir(parents=True)
    write_report(outcomes, "quick", tmp_path)
    told = capsys.readouterr().out
    assert "white, small object, hashgrid: 1 of 3 failed (no collapse); seed 2: collapsed: no density" in told
    table = (tmp_path / "stability.md").read_text()
    assert "| clean | the yardstick of all others | 28.0 dB |" in table
    assert "18.0 dB, 1 of 3 failed, 2 recovered" in table and "| refused |" in table
    assert "| shuffled poses | refused, or an alarm | 16.0 dB, alarm |" in table
    saved = json.loads((tmp_path / "stability.json").read_text())
    assert set(saved["cells"][0]) >= {"condition", "method", "seed", "guard", "psnr", "status", "diagnosis"}
    for name in ("heatmap.png", "worst.png"):
        assert imageio.imread(tmp_path / name).std() > 0 or name == "worst.png"
    assert table.startswith(markdown(squares(outcomes)))
    for text in (told, table):
        assert "shipped recipes: 1 of 8 cells failed" in text


def test_controls_and_what_the_guard_makes_of_them():
    without = replace(GOOD, method="relu mlp, no guard", guard=False)
    guarded = replace(GOOD, method="relu mlp", recoveries=1)
    lost = replace(without, psnr=12.0, status="collapsed")
    outcomes = [replace(without, seed=0, psnr=30.0), replace(lost, seed=1), replace(lost, seed=2)]
    outcomes += [replace(guarded, seed=0), replace(guarded, seed=1, psnr=28.1), replace(guarded, seed=2, psnr=27.9)]
    outcomes += [replace(lost, condition="rate x30"), replace(guarded, condition="rate x30", psnr=29.0)]
    saved = rescues(outcomes)
    assert [(one.condition, one.seed, one.undisturbed, one.back) for one in saved] == [
        ("clean", 1, 30.0, True), ("clean", 2, 30.0, False), ("rate x30", 0, 30.0, True),
    ]  # fmt: skip
    told = summary(squares(outcomes), saved)
    assert "clean, relu mlp, no guard (2 of 3); rate x30, relu mlp, no guard (1 of 1)" in told[0]
    assert "2 of 3 broken control runs brought back to within 2 dB" in told[1]
    assert "proves nothing" in summary(squares(outcomes[:1]), [])[0]


@pytest.mark.parametrize(
    ("suite", "methods", "words"), [("all", None, "suite"), ("quick", ["nerf"], "methods"), ("quick", [], "found none")]
)
def test_unknown_names_are_told(suite: str, methods: list[str] | None, words: str, tmp_path: Path):
    with pytest.raises(InputError, match=words):
        stability(suite, methods, 1, 10, 1, str(tmp_path))


def test_a_seed_is_held_against_its_own_clean_run():
    """Seeds differ among themselves: a low one is no failure where the same seed is as low without the condition."""
    clean = [replace(GOOD, seed=seed, psnr=psnr) for seed, psnr in enumerate((30.0, 27.0, 30.0))]
    scaled = [replace(one, condition="world x10") for one in clean]
    assert [len(square.failed) for square in squares([*clean, *scaled])] == [0, 0]
    assert [len(square.failed) for square in squares([*clean, *scaled[:2], replace(scaled[2], psnr=28.5)])] == [0, 1]
