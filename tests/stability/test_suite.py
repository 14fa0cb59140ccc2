"""The suite: which trials there are, what becomes of one, and what is made of all."""

import json
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import psutil
import pytest
import torch

from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import Picture
from nerf_lightning.stability.conditions import CONDITIONS, METHODS, make_waves
from nerf_lightning.stability.report import find_rescues, is_passed, judge_trials, summarize, write_report
from nerf_lightning.stability.trial import Trial, TrialResult, get_trial_folder, list_trials, run_trial, run_trials

GOOD = TrialResult("clean", "hashgrid", 0, 30.0, "finished", "", 0, "")


@pytest.mark.parametrize("name", CONDITIONS)
def test_condition_has_scene_and_options_that_compose(name: str, tmp_path: Path):
    condition = CONDITIONS[name]
    assert isinstance(condition.make(0), Picture) == condition.is_2d
    tried = {m.kind: m.get_options_for(condition) for m in METHODS.values() if m.is_2d == condition.is_2d}
    given = [options for options in tried.values() if options is not None]
    assert given
    photos = [] if condition.is_2d else ["dataset=photos", "dataset.path=x"]
    for options in given if condition.options or condition.by_kind else given[:1]:
        compose_config([*photos, *options], tmp_path)


def test_make_waves_holds_all_frequencies_down_to_six_pixels_of_training():
    image = make_waves(96, 16).image
    assert image.shape == (32, 192, 3)
    spectrum = torch.fft.rfft(image[0, :, 0].float() - 127.5).abs()
    assert (spectrum[1:16] > 100).float().mean() > 0.8
    assert spectrum[20:].max() < 0.2 * spectrum.max(), "nothing that the smaller image cannot show"


def test_list_trials_unsolvable_conditions_have_one_seed():
    names = ["clean", "OpenGL poses", "tiny hash table", "2D: clean"]
    trials = list_trials(names, ["hashgrid", "mlp", "2D mlp"], 2, 10)
    assert [(one.condition, one.method, one.seed) for one in trials] == [
        ("clean", "hashgrid", 0), ("clean", "hashgrid", 1), ("clean", "mlp", 0), ("clean", "mlp", 1),
        ("OpenGL poses", "hashgrid", 0), ("OpenGL poses", "mlp", 0),
        ("tiny hash table", "hashgrid", 0), ("tiny hash table", "hashgrid", 1),
        ("2D: clean", "2D mlp", 0), ("2D: clean", "2D mlp", 1),
    ]  # fmt: skip


@pytest.mark.parametrize("method", [n for n, m in METHODS.items() if m.recovery_twin is None and n != "relu mlp"])
def test_run_trial_every_method_learns_something(method: str, tmp_path: Path):
    result = run_trial(Trial("2D: clean" if METHODS[method].is_2d else "black, small object", method, 0, 30), tmp_path)
    assert result.status == "finished", result
    assert result.psnr is not None and result.psnr > 10


def test_run_trial_is_done_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    trial = Trial("OpenGL poses", "voxels", 0, 20)
    result = run_trial(trial, tmp_path)
    assert result.status == "refused" and "axes of the other convention" in result.diagnosis
    assert str(tmp_path) not in result.diagnosis
    monkeypatch.setattr("nerf_lightning.stability.trial.train_trial", lambda *_: pytest.fail("trained again"))
    assert run_trial(trial, tmp_path) == result
    with pytest.raises(pytest.fail.Exception):
        run_trial(replace(trial, steps=21), tmp_path)
    (get_trial_folder(tmp_path, trial.condition, trial.method, 0) / "trial.json").write_text('{"identity": ')
    with pytest.raises(pytest.fail.Exception):
        run_trial(trial, tmp_path)


def test_run_trial_excess_frequencies_fail_between_pixels(tmp_path: Path):
    result = run_trial(Trial("2D: L = 40", "2D mlp", 0, 150), tmp_path)
    assert result.status == "finished" and "off the pixel grid" in result.alarm
    assert result.psnr is not None and result.psnr < 15


def test_run_trials_processes_end_with_generator(tmp_path: Path):
    trials = [Trial("OpenGL poses", method, 0, 20) for method in ("voxels", "hashgrid")]
    waiting = [Trial("clean", "hashgrid", seed, 100_000) for seed in range(6)]
    found = run_trials([*trials, *waiting], tmp_path, 1)
    results = [next(found), next(found)]
    assert [(one.method, one.status) for one in results] == [("voxels", "refused"), ("hashgrid", "refused")]
    found.close()  # as an interruption does
    assert not [one for one in psutil.Process().children() if "loky_posix" in " ".join(one.cmdline())]


@pytest.mark.parametrize(
    ("name", "result", "good"),
    [
        ("clean", GOOD, True),
        ("clean", replace(GOOD, status="collapsed"), False),
        ("OpenGL poses", replace(GOOD, psnr=None, status="refused"), True),
        ("OpenGL poses", GOOD, False),
        ("shuffled poses", replace(GOOD, alarm="inconsistent silhouettes"), True),
        ("world x10", replace(GOOD, psnr=29.5), True),
        ("world x10", replace(GOOD, psnr=28.5), False),
    ],
)
def test_is_passed_follows_condition(name: str, result: TrialResult, good: bool):
    assert is_passed(replace(result, condition=name), CONDITIONS[name], clean=30.0) == good


def test_judge_compares_a_seed_with_its_own_clean_run():
    clean = [replace(GOOD, seed=seed, psnr=psnr) for seed, psnr in enumerate((30.0, 27.0, 30.0))]
    scaled = [replace(one, condition="world x10") for one in clean]
    assert [len(one.failed) for one in judge_trials([*clean, *scaled])] == [0, 0]
    assert [len(one.failed) for one in judge_trials([*clean, *scaled[:2], replace(scaled[2], psnr=28.5)])] == [0, 1]


def test_find_rescues_compares_recovery_twin_with_clean_runs():
    without = replace(GOOD, method="relu mlp, no recovery")
    guarded = replace(GOOD, method="relu mlp", recoveries=1)
    lost = replace(without, psnr=12.0, status="collapsed")
    results = [replace(without, seed=0, psnr=30.0), replace(lost, seed=1), replace(lost, seed=2)]
    results += [replace(guarded, seed=0), replace(guarded, seed=1, psnr=28.1), replace(guarded, seed=2, psnr=27.9)]
    results += [replace(lost, condition="rate x30"), replace(guarded, condition="rate x30", psnr=29.0)]
    rescues = find_rescues(results)
    assert rescues == [True, False, True]
    lines = summarize(judge_trials(results), rescues)
    assert "clean, relu mlp, no recovery (2/3 failed); rate x30, relu mlp, no recovery (1/1 failed)" in lines[0]
    assert "2 of 3" in lines[1]
    assert "proves nothing" in summarize(judge_trials(results[:1]), [])[0]


def test_write_report_lists_failures(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    bad = replace(GOOD, condition="white, small object", seed=2, psnr=18.0, status="collapsed", diagnosis="no density")
    results = [GOOD, *(replace(bad, seed=seed, psnr=33.0, status="finished") for seed in range(2)), bad]
    results += [replace(GOOD, condition="OpenGL poses", method="mlp", psnr=None, status="refused")]
    render = get_trial_folder(tmp_path, bad.condition, bad.method, bad.seed) / "final.png"
    render.parent.mkdir(parents=True)
    imageio.imwrite(render, torch.full((8, 8, 3), 90, dtype=torch.uint8).numpy())
    content = write_report(results, "quick", tmp_path)
    assert content == json.loads((tmp_path / "stability.json").read_text()) and len(content["cells"]) == 5
    printed = capsys.readouterr().out
    assert "white, small object, hashgrid: 1/3 failed (no collapse); seed 2: collapsed: no density" in printed
    assert "1 of 5 trials failed" in printed and "1 of 5 trials failed" in content["summary"][0]
    heatmap = imageio.imread(tmp_path / "heatmap.png")
    assert (heatmap == (213, 94, 0)).all(-1).mean() > 0.01, "the failed cell is vermillion"
    assert (imageio.imread(tmp_path / "worst.png") == 90).all(-1).mean() > 0.1
    assert [judge_trials(results)[n].describe() for n in (1, 2)] == [["18.0 dB", "1/3 failed"], ["refused"]]
