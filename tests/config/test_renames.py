"""Old option names go on to work: on the command line, in a user's experiment, in runs made before."""

import inspect
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from nerf_lightning.config.build import target_of
from nerf_lightning.config.compose import composed
from nerf_lightning.config.renames import RENAMED, rename_given
from nerf_lightning.runs.folder import plain_config
from nerf_lightning.runs.trusted import check_config


def value_at(cfg, key: str) -> object:
    return OmegaConf.select(cfg, key)


@pytest.mark.parametrize(("old", "new"), RENAMED.items())
def test_an_old_name_does_what_the_new_one_does(old: str, new: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    given = composed([f"{old}=0.25"], tmp_path)
    assert given == composed([f"{new}=0.25"], tmp_path) and value_at(given, new) == 0.25
    assert f"{old} is now called {new}" in capsys.readouterr().err

    group, name = old.split(".")
    experiment = composed([], tmp_path)  # a file may add a key that conf/ does not have
    OmegaConf.update(experiment, old, 0.25, force_add=True)
    rename_given(experiment)
    assert value_at(experiment, new) == 0.25 and name not in experiment[group]
    assert f"{old} is now called {new}" in capsys.readouterr().err

    plain = {"model": {}, group: {"first": 1, name: 0.25}}
    assert check_config(plain, "config.yaml")[group] == {"first": 1, new.split(".")[1]: 0.25}
    assert capsys.readouterr().err == "", "a run that is there already stays as it is"


def test_grids_of_runs_that_say_no_size_are_as_fine_as_asked_for():
    for target, size in (("nerf_lightning.model.TensoRFField", "fixed"), ("nerf_lightning.model.MLPField", None)):
        assert check_config({"model": {"_target_": target}}, "config.yaml")["model"].get("size") == size
    model = {"_target_": "nerf_lightning.model.VoxelField", "size": "auto"}
    assert check_config({"model": model}, "config.yaml")["model"] == model


@pytest.mark.parametrize("method", ["hashgrid", "tensorf", "voxels", "hashgrid2d"])
def test_what_a_run_leaves_out_of_these_is_kept_as_it_is_today(method: str, tmp_path: Path):
    option = "share" if method == "hashgrid2d" else "size"
    cfg = composed(
        ["dataset=photos", "dataset.path=x", f"model={method}", f"~model.{option}", "~dataset.undistort"], tmp_path
    )
    kept = check_config(plain_config(cfg), "config.yaml")
    made, read = (inspect.signature(target_of(cfg, group)).parameters for group in ("model", "dataset"))
    assert kept["model"][option] == made[option].default
    assert kept["dataset"]["undistort"] == read["undistort"].default


def test_new_names_are_options(tmp_path: Path):
    cfg = composed([], tmp_path)
    assert all(value_at(cfg, new) is not None and value_at(cfg, old) is None for old, new in RENAMED.items())


def test_runs_on_photos_that_say_nothing_of_lenses_had_them_undone():
    dataset = {"_target_": "nerf_lightning.dataset.from_photos", "path": "x"}
    assert check_config({"dataset": dataset}, "config.yaml")["dataset"]["undistort"] is True
    said = {**dataset, "undistort": False}
    assert check_config({"dataset": said}, "config.yaml")["dataset"] == {"focus": 0.0, **said}


def test_runs_from_before_a_new_default_go_on_with_theirs():
    scene = {"_target_": "nerf_lightning.dataset.from_bricks", "rays": 64}
    assert check_config({"dataset": scene}, "config.yaml")["dataset"]["focus"] == 0
    picture = {"_target_": "nerf_lightning.model.HashGrid2DField", "levels": 8, "log2_entries": None, "rate": 1.0}
    assert check_config({"model": picture}, "config.yaml")["model"]["share"] == 0.5
    assert check_config({"model": {**picture, "share": 1.0}}, "config.yaml")["model"]["share"] == 1.0
    assert "focus" not in check_config({"dataset": {"_target_": "nerf_lightning.dataset.from_picture"}}, "x")["dataset"]
