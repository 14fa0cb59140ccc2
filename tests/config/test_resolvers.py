"""Folders named after the command line."""

import pytest

from nerf_lightning.config.resolvers import MAX_SLUG_CHARS, fixed_keys, job_name, slugify, sweep_folder


def test_slugify_replaces_reserved_characters():
    assert slugify("model.width=16,path=/a b/'c'") == "model.width=16,path=-a-b--c-"
    assert slugify("") == "all"


def test_slugify_long_text_is_truncated_with_hash():
    first, second = (slugify("x=" + "a" * 300 + end) for end in "01")
    assert len(first) == len(second) == MAX_SLUG_CHARS and first != second
    assert slugify("x" * MAX_SLUG_CHARS) == "x" * MAX_SLUG_CHARS


@pytest.mark.parametrize(
    ("arguments", "folder"),
    [
        (["seed=0,1", "-m", "+experiment=lego", "hydra/launcher=joblib"], "outputs/lego/sweep_seed=0,1"),
        (["-m", "model.width=1,2", "name=mine", "+experiment=lego"], "outputs/mine/sweep_model.width=1,2"),
        (["+experiment=study_grid"], "outputs/study_grid/sweep"),
        (["-m", "overwrite=true", "seed=0,1"], "outputs/run/sweep_seed=0,1"),
        (["-m", "~callbacks.orbit", "seed=0,1"], "outputs/run/sweep_seed=0,1_-callbacks.orbit="),
    ],
)  # fmt: skip
def test_sweep_folder_is_named_after_the_command_line(arguments: list[str], folder: str):
    assert sweep_folder(arguments) == folder


def test_job_name_leaves_out_fixed_keys():
    arguments = ["-m", "+experiment=lego", "budget.steps=5", "x=1e-6", "seed=0,1", "model.width=choice(8,16)"]
    fixed = fixed_keys([*arguments, "optimizer.lr=interval(1e-4,1e-2)", "callbacks.validation.fractions=[0.1,0.2]"])
    assert fixed == ["budget.steps", "callbacks.validation.fractions", "experiment", "x"]
    overrides = ["+experiment=lego", "model.width=8", "seed=1", "budget.steps=5", "x=1e-06"]
    assert job_name(overrides, fixed) == "model.width=8,seed=1"
    assert job_name(["seed=0"], fixed_keys(["-m", "seed=0"])) == "all"
