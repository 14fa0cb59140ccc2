"""The command on small scenes, and the ladders."""

from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import pytest
import torch
import yaml

from nerf_lightning.cameras import Bounds
from nerf_lightning.cli.rightsize import describe_scene, rightsize
from nerf_lightning.config import conf_dir
from nerf_lightning.config.build import ImageMetadata, SceneMetadata, build_data, build_system
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import save_npz
from nerf_lightning.errors import InputError
from nerf_lightning.model import VoxelField
from nerf_lightning.runs.compact import load_compact
from nerf_lightning.sizing import search
from nerf_lightning.sizing.choose import Target, read_ladder
from nerf_lightning.synthetic.objects import PILE, make_object_scene
from tests.helpers.growth import grow

COMPONENTS = {"density_components": 3, "color_components": 3}
RUNGS = [
    {**COMPONENTS, "base_resolution": 4, "max_resolution": 4, "width": 8, "stages": 1},
    {**dict.fromkeys(COMPONENTS, 8), "base_resolution": 8, "max_resolution": 16, "width": 16},
    {**dict.fromkeys(COMPONENTS, 8), "base_resolution": 8, "max_resolution": 24, "width": 16},
]
SAMPLERS = [{"samples": 32, "resolution": 8}, {"samples": 64, "resolution": 16}]
FAST = ["threads=1", "device=cpu", "callbacks.snapshots.steps=[]", "budget.steps=60"]
SCENE = SceneMetadata(Bounds(torch.tensor([[-1.0] * 3, [1.0] * 3])), (0.0, 0.0, 0.0))


@pytest.fixture
def scene(tmp_path: Path) -> str:
    save_npz(make_object_scene(PILE, size=16, views=8, held_out=2), tmp_path / "scene.npz")
    (tmp_path / "ladder.yaml").write_text(yaml.safe_dump({"rungs": RUNGS, "samplers": SAMPLERS}))
    return str(tmp_path / "scene.npz")


def search_small(scene: str, overrides: list[str] = [], **options: Any) -> dict[str, Any]:  # noqa: B006
    folder = Path(scene).parent
    given = ["recipe=tensorf_medium", "callbacks.orbit=null", *FAST, *overrides]
    return rightsize(scene, *given, **{"ladder": str(folder / "ladder.yaml"), "output": folder / "found", **options})


def test_rightsize_writes_smallest_run_and_experiment(scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    found = search_small(scene, psnr=14.0)
    folder, rung = tmp_path / "found", found["rung"]
    assert found["reached"] and found["full"][str(rung)]["psnr"] >= 14
    assert all(one["psnr"] < 14 for number, one in found["full"].items() if int(number) < rung)
    assert found["model"] == RUNGS[rung] and found["sampler"] in SAMPLERS
    assert (folder / "compact.npz").stat().st_size == found["artifact_bytes"]
    assert load_compact(folder / "compact.npz").system.background == [0.0, 0.0, 0.0]
    assert imageio.imread(folder / "chart.png").std() > 10
    own = yaml.safe_load((folder / "best.yaml").read_text())
    assert {key: own["model"][key] for key in RUNGS[rung]} == RUNGS[rung]
    assert own["sampler"]["samples"] == found["sampler"]["samples"] and own["dataset"]["path"] == scene
    monkeypatch.setattr(search, "climb_ladder", lambda *_: pytest.fail("climbed again"))
    assert search_small(scene, psnr=14.0) == found, "a finished search is only reported again"
    with pytest.raises(InputError, match="holds something else"):
        search_small(scene, psnr=15.0)


def test_rightsize_interrupted_keeps_full_trainings(scene: str, tmp_path: Path, monkeypatch):
    few = ["budget.steps=8", "sampler.resolution=16"]
    (tmp_path / "ladder.yaml").write_text(yaml.safe_dump({"rungs": RUNGS[:2], "samplers": SAMPLERS[:1]}))
    with monkeypatch.context() as patched:
        patched.setattr(search, "compress_system", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            search_small(scene, few, psnr=90.0)
    monkeypatch.setattr(search, "train", lambda *_: pytest.fail("trained again"))
    found = search_small(scene, few, psnr=90.0)
    assert not found["reached"] and (tmp_path / "found" / "rightsize.json").exists()


def test_rightsize_accepts_images(tmp_path: Path):
    imageio.imwrite(tmp_path / "a b.png", torch.arange(32 * 32 * 3).view(32, 32, 3).remainder(251).byte().numpy())
    given = ["model=picture_mlp", "callbacks.pictures=null", *FAST]
    found = rightsize(str(tmp_path / "a b.png"), *given, within_db=100.0, output=tmp_path / "found")
    assert found["rung"] == 0 and found["reached"] and found["sampler"] == {}


@pytest.mark.parametrize(
    ("overrides", "options", "message"),
    [
        ([], {"psnr": 3.0, "within_db": 1.0}, "one of the two"),
        ([], {"ladder": "none_such"}, "none_such"),
        ([], {"output": Path()}, "holds other files"),
        (["budget.second=60"], {}, "budget.seconds"),
        (["sampler.samples=-1"], {}, "sampler.samples"),
    ],
)
def test_rightsize_bad_options_write_nothing(
    overrides: list[str], options: dict, message: str, scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        search_small(scene, overrides, **options)
    assert {file.name for file in tmp_path.iterdir()} == {"scene.npz", "ladder.yaml"}


def test_describe_scene_distinguishes_experiments_scenes_and_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lego").mkdir()
    (tmp_path / "cat (1).JPG").touch()
    assert describe_scene("lego") == ["+experiment=lego"] and describe_scene("bricks") == ["dataset=bricks"]
    assert describe_scene("./lego") == ["dataset=photos", "dataset.path=lego"]
    kind, path = describe_scene("cat (1).JPG")
    assert kind == "+experiment=picture" and "cat (1).JPG" in path
    with pytest.raises(InputError, match="no_such"):
        describe_scene("no_such")


@pytest.mark.parametrize(
    ("recipe", "rungs"),
    [
        (
            "hashgrid_small",
            [{"width": 16, "num_levels": 3}, {"width": 8, "num_levels": 3}, {"width": 8, "num_levels": 2}],
        ),
        (
            "tensorf_small",
            [{**RUNGS[1], "width": None}, {**RUNGS[1], "width": 8}, {**RUNGS[1], "color_components": 3}],
        ),
    ],
)
def test_climb_ladder_smaller_option_restarts(recipe: str, rungs: list[dict], scene: str, tmp_path: Path):
    small = ["sampler.samples=32", "sampler.resolution=16", "dataset.samples=1000"]
    given = ["dataset=photos", f"dataset.path={scene}", f"recipe={recipe}", *FAST[:-1], "budget.steps=4", *small]
    cfg = compose_config(given, tmp_path)
    found, _ = search.climb_ladder(cfg, build_data(cfg), rungs, Target(psnr=99.0), tmp_path)
    assert len(found) == 3 and min(one.psnr for one in found) > 3


@pytest.mark.parametrize(
    ("given", "steps"), [([], search.RUNG_STEPS), (["budget.seconds=10"], search.RUNG_STEPS), (["budget.steps=40"], 3)]
)
def test_configure_rung_counts_steps_whatever_the_budget(given: list[str], steps: int, tmp_path: Path):
    part = search.configure_rung(compose_config([*given, "budget.patience=1"], tmp_path), [{"width": 8}] * 10, 0)
    assert (part.budget.steps, part.budget.seconds, part.budget.patience) == (steps, None, None)
    assert set(part.callbacks) == {"recovery"} and part.logger is None and part.model.width == 8


@pytest.mark.parametrize("name", sorted(path.stem for path in (conf_dir() / "ladders").glob("*.yaml")))
def test_shipped_ladder_rungs_can_be_built_and_grow(name: str, tmp_path: Path):
    ladder, sizes = read_ladder(name), []
    flat = not ladder.samplers
    cfg = compose_config(["+experiment=picture", f"model={name}"] if flat else [f"recipe={name}_medium"], tmp_path)
    for options in ladder.rungs:
        system = build_system(search.set_options(cfg, "model", options), ImageMetadata(640, 480) if flat else SCENE)
        if isinstance(system.field, VoxelField):  # the whole box takes long
            system.field.prune(torch.zeros(4, 4, 4, dtype=torch.bool).index_fill(0, torch.tensor([1]), True))
        if not flat:
            grow(system.field, 1.0)
        sizes.append(sum(parameter.numel() for parameter in system.parameters()))
    assert sizes == sorted(set(sizes))
    for options in ladder.samplers:
        build_system(search.set_options(cfg, "sampler", options), SCENE)


def test_read_ladder_invalid_file_raises(tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text("rungs: [{width: 8}, {width: 16}]")
    assert read_ladder(str(path)).rungs == [{"width": 8}, {"width": 16}]
    path.write_text("rungs: [8, 9]")
    with pytest.raises(InputError, match="mine.yaml"):
        read_ladder(str(path))
