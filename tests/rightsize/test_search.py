"""The verb as a user meets it, on small scenes."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from nerf_lightning.config import cli
from nerf_lightning.config.build import build_data, build_system, frame_of
from nerf_lightning.config.compose import composed
from nerf_lightning.dataset import save_npz
from nerf_lightning.errors import InputError
from nerf_lightning.rightsize.__main__ import task
from nerf_lightning.rightsize.choose import Target
from nerf_lightning.rightsize.climb import climb, coarsest_sampler, quality
from nerf_lightning.rightsize.ladder import Ladder
from nerf_lightning.rightsize.start import begin
from nerf_lightning.runs.compact import load_compact
from nerf_lightning.runs.folder import load_config
from nerf_lightning.runs.index import read_run
from nerf_lightning.stability.toys import PILE, toy
from nerf_lightning.system import NeRF3D
from nerf_lightning.training.before import left_of

RUNGS = [
    {"density_components": 3, "colour_components": 3, "coarsest": 4, "finest": 4, "width": 8, "stages": 1},
    {"density_components": 8, "colour_components": 8, "coarsest": 8, "finest": 16, "width": 16},
    {"density_components": 8, "colour_components": 8, "coarsest": 8, "finest": 24, "width": 16},
]


@pytest.fixture
def given(tmp_path: Path) -> list[str]:
    save_npz(toy(PILE, size=16, views=8, held_out=2), tmp_path / "scene.npz")
    ladder = {"rungs": RUNGS, "samplers": [{"samples": 32, "resolution": 8}, {"samples": 64, "resolution": 16}]}
    (tmp_path / "ladder.yaml").write_text(yaml.safe_dump(ladder))
    return [
        "dataset=photos",
        f"dataset.path={tmp_path}/scene.npz",
        "recipe=tensorf_medium",
        f"ladder={tmp_path}/ladder.yaml",
        "budget.steps=60",
        "threads=1",
        "device=cpu",
        "callbacks.orbit=null",
        "callbacks.snapshots.steps=[]",
        f"output={tmp_path}/found",
    ]


def search(given: list[str], folder: Path) -> dict:
    task(composed(given, folder, "rightsize"))
    return json.loads((folder / "found" / "rightsize.json").read_text())


def test_a_search_leaves_the_smallest_that_is_enough_and_an_experiment_to_train_it_again(
    given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    found = search([*given, "target.psnr=14"], tmp_path)
    assert found["target"] == {"psnr": 14, "within_db": None} and found["reached"]
    assert found["device"] == "cpu" and found["machine"].keys() == {"processor", "cores", "accelerator"}
    choice = found["chosen"]["rung"]
    mine = found["rungs"][choice]
    assert mine["psnr"] >= 14 and all(rung["psnr"] < 14 for rung in found["rungs"][:choice] if rung["run"])
    assert set(mine) >= {"overrides", "parameters", "artifact_bytes", "psnr", "train_seconds"}
    path = tmp_path / "found"
    assert (path / "compact.npz").stat().st_size == found["chosen"]["artifact_bytes"]
    assert (path / "chart.png").stat().st_size > 5000
    assert found["reason"] in capsys.readouterr().out
    assert load_compact(path / "compact.npz").system.background == [0.0, 0.0, 0.0]
    monkeypatch.chdir(tmp_path)
    (argument,) = cli.by_path(["+experiment=found/best.yaml"], cli.conf_dir())
    cfg = composed([argument], tmp_path)
    assert {key: cfg.model[key] for key in RUNGS[choice]} == RUNGS[choice]
    sampler = dict(part.split("=") for part in found["chosen"]["overrides"] if part.startswith("sampler."))
    assert cfg.sampler.samples == int(sampler["sampler.samples"])
    assert cfg.dataset.path == f"{tmp_path}/scene.npz" and cfg.budget.steps == 60


def test_other_arguments_stay_as_they_are(tmp_path: Path):
    (tmp_path / "here.yaml").write_text("")
    given = ["+experiment=lego", f"dataset.path={tmp_path}/here.yaml", f"+experiment={tmp_path}/missing.yaml", "-m"]
    assert cli.by_path(given, cli.conf_dir()) == given


def test_a_target_out_of_reach_is_told(given: list[str], tmp_path: Path):
    found = search([*given, "target.psnr=90", "budget.steps=8"], tmp_path)
    assert not found["reached"] and "was not reached" in found["reason"]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["target.psnr=high"], "target.psnr: found 'high', expected a number or null"),
        (["target=28"], "config: target: found 28, expected psnr, within_db, each by its name"),
        (["target.psnr=3", "target.within_db=1"], "one of the two"),
        (["ladder=none_such"], "ladder: found 'none_such'"),
        (["output=."], "something in it already"),
        (["threads=0"], "threads: found 0"),
        (["budget.steps={}"], "budget.steps: found {}"),
        (["callbacks.heldout.views=nan"], "callbacks.heldout.views: found nan"),
        (["sampler.samples=-1"], "sampler.samples: found -1"),
    ],
)
def test_bad_input_is_told_in_one_line_and_leaves_nothing(extra: list[str], message: str, given: list[str], verb):
    before = set(Path.cwd().iterdir())
    code, _, err = verb(lambda: cli.run("rightsize", task), *given, *extra)
    assert code == 2 and err.count("\n") == 1 and message in err
    assert set(Path.cwd().iterdir()) <= before


def test_a_search_goes_on_where_the_same_one_was_interrupted(given: list[str], tmp_path: Path):
    cfg, ladder, output = composed(given, tmp_path, "rightsize"), Ladder(RUNGS, []), tmp_path / "found"
    cfg.name = math.nan  # no JSON number
    begin(output, cfg, Target(psnr=14), ladder)
    begin(output, cfg, Target(psnr=14), ladder)
    for target, sizes in ((Target(psnr=15), RUNGS), (Target(psnr=14), RUNGS[:2])):
        with pytest.raises(InputError, match="another search in it already"):
            begin(output, cfg, target, Ladder(sizes, []))
    (output / "rightsize.json").write_text("{}")
    with pytest.raises(InputError, match="a finished search in it already"):
        begin(output, cfg, Target(psnr=14), ladder)


def test_what_was_trained_in_full_is_not_trained_again(small_run: Path, tmp_path: Path):
    folder = shutil.copytree(small_run, tmp_path / "run")
    cfg = load_config(folder)
    done, checkpoint = left_of(read_run(folder), cfg)
    assert done is not None and checkpoint is None
    (folder / "results.json").write_text(json.dumps({**done.results, "status": "interrupted"}))
    assert left_of(read_run(folder), cfg) == (None, folder / "checkpoints" / "last.ckpt")
    cfg.seed += 1
    assert left_of(read_run(folder), cfg) == (None, None), "another run"


def test_a_picture_has_a_ladder_too(tmp_path: Path):
    given = ["+experiment=picture", "model=picture_mlp", "dataset.max_side=32", "budget.steps=60", "threads=1"]
    quiet = ["training_gif=null", "charts=null", "baselines=null", "snapshots.steps=[]"]
    given += [f"callbacks.{one}" for one in quiet]
    found = search([*given, "target.within_db=100", f"output={tmp_path}/found"], tmp_path)
    assert found["chosen"]["rung"] == 0 and found["reached"], "a hundred dB below the best is anything"


@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")  # Lightning's progress bar, with PyTorch as it is now
@pytest.mark.parametrize(
    ("recipe", "rungs"),
    [
        ("hashgrid_small", [{"width": 16, "levels": 3}, {"width": 8, "levels": 3}, {"width": 8, "levels": 2}]),
        (
            "tensorf_small",
            [{**RUNGS[1], "width": None}, {**RUNGS[1], "width": 8}, {**RUNGS[1], "colour_components": 3}],
        ),
    ],
)
def test_a_rung_that_is_smaller_in_something_starts_anew(
    recipe: str, rungs: list[dict], given: list[str], tmp_path: Path
):
    options = [one for one in given if not one.startswith(("recipe", "budget", "ladder"))]
    options += [
        f"recipe={recipe}",
        "budget.steps=4",
        "sampler.samples=32",
        "sampler.resolution=16",
        "dataset.samples=1000",
    ]
    cfg = composed(options, tmp_path, "rightsize")
    climbed = list(climb(cfg, build_data(cfg), rungs, tmp_path))
    assert [rung.options for rung in climbed] == rungs and all(rung.psnr > 3 for rung in climbed)


def test_views_without_a_figure_do_not_count_and_a_field_without_any_is_refused(
    given: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    cfg = composed(given, tmp_path, "rightsize")
    data = build_data(cfg)
    system = build_system(cfg, frame_of(data))
    whole = [result.psnr for result in system.evaluate_held_out(data, range(2))]
    evaluate = NeRF3D.evaluate_held_out

    def unknown(self: NeRF3D, *given: Any) -> list:
        first, *others = evaluate(self, *given)
        return [replace(first, psnr=math.nan), *others]

    monkeypatch.setattr(NeRF3D, "evaluate_held_out", unknown)
    assert quality(system, data) == pytest.approx(whole[1])
    for parameter in system.parameters():
        parameter.data.fill_(math.nan)
    with pytest.raises(InputError, match="found pictures that are not finite"):
        quality(system, data)


def test_samplers_that_do_not_fit_are_refused(given: list[str], tmp_path: Path):
    cfg = composed([*given, "target.psnr=14"], tmp_path, "rightsize")
    data = build_data(cfg)
    with pytest.raises(InputError, match=r"config: dataset.rays: found 1,024 rays a step, with"):
        coarsest_sampler(cfg, data, build_system(cfg, frame_of(data)), [{"samples": 10**12}])
