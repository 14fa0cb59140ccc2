"""Ladders are configuration, and what they hold fits the models."""

import copy
from pathlib import Path

import pytest
import torch

from nerf_lightning.cameras import Bounds
from nerf_lightning.config import cli
from nerf_lightning.config.build import PictureFrame, SceneFrame, build_system
from nerf_lightning.config.compose import composed
from nerf_lightning.errors import InputError
from nerf_lightning.model import VoxelField
from nerf_lightning.rightsize.climb import RUNG_STEPS, for_a_rung, set_options
from nerf_lightning.rightsize.ladder import overrides, read_ladder

SHIPPED = cli.conf_dir() / "ladders"
SCENE = SceneFrame(Bounds(torch.tensor([[-1.0] * 3, [1.0] * 3])), (0.0, 0.0, 0.0))
CELL = torch.zeros(4, 4, 4, dtype=torch.bool)
CELL[1, 1, 1] = True
"""Where something stands: voxels are refined there alone, as the whole box takes long."""


@pytest.mark.parametrize("name", sorted(path.stem for path in SHIPPED.glob("*.yaml")))
def test_every_rung_of_the_shipped_ladders_can_be_built_and_is_larger_than_the_last(name: str, tmp_path: Path):
    ladder = read_ladder(name, SHIPPED)
    flat = not ladder.samplers
    given = ["+experiment=picture", f"model={name}"] if flat else [f"recipe={name}_medium"]
    cfg = composed(given, tmp_path)
    sizes = []
    for options in ladder.rungs:
        system = build_system(set_options(cfg, "model", options), PictureFrame(640, 480) if flat else SCENE)
        if isinstance(system.field, VoxelField):
            system.field.prune(CELL)
        if not flat:
            system.field.grow(1.0)
        sizes.append(sum(parameter.numel() for parameter in system.parameters()))
    assert sizes == sorted(set(sizes))
    for options in ladder.samplers:
        build_system(set_options(cfg, "sampler", options), SCENE)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[]", "rungs"),
        ("rungs: [{width: 8}]", "rungs"),
        ("rungs: [8, 9]", "rungs"),
        ("rungs: [{}, {}]\nsamplers: 3", "samplers"),
    ],
)
def test_a_ladder_of_ones_own_and_what_is_none(text: str, key: str, tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text("rungs: [{width: 8}, {width: 16}]")
    assert read_ladder(str(path), SHIPPED).rungs == [{"width": 8}, {"width": 16}]
    path.write_text(text)
    with pytest.raises(InputError, match=f"mine.yaml: {key}: found something else"):
        read_ladder(str(path), SHIPPED)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("fourier", "ladder: found 'fourier', expected one of .*tensorf"),
        ("no/such.yaml", "such.yaml: found nothing there"),
    ],
)
def test_an_unknown_ladder_is_told(name: str, words: str):
    with pytest.raises(InputError, match=words):
        read_ladder(name, SHIPPED)


def test_options_as_a_command_line_gives_them():
    assert overrides("model", {"width": 8, "skip": None}) == ["model.width=8", "model.skip=null"]


@pytest.mark.parametrize(
    ("given", "steps"),
    [
        ([], RUNG_STEPS),
        (["budget.seconds=10"], RUNG_STEPS),
        (["budget.steps=40"], 3),
        (["budget.steps=1", "budget.seconds=8"], 1),
    ],
)
def test_rungs_are_trained_in_steps_however_long_they_take(given: list[str], steps: int, tmp_path: Path):
    cfg = composed([*given, "budget.patience=1"], tmp_path)
    before = copy.deepcopy(cfg)
    part = for_a_rung(cfg, 10)
    assert (part.budget.steps, part.budget.seconds, part.budget.patience) == (steps, None, None)
    assert set(part.callbacks) == {"guard"} and part.logger is None
    assert cfg == before


def test_options_that_are_no_plain_values_are_refused(tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text("rungs: [{width: 8}, {width: 16}]\nsamplers: [{samples: -.inf}]")
    with pytest.raises(InputError, match="mine.yaml: samplers: found something else"):
        read_ladder(str(path), SHIPPED)
