"""The photos of a run read back: those it was trained on or none, from anywhere, and never from the network."""

import urllib.request
from pathlib import Path
from typing import Any

import pytest
import torch

from nerf_lightning.config.build import build_data
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import Views, save_npz
from nerf_lightning.errors import InputError
from nerf_lightning.runs.folder import load_config, save_config
from nerf_lightning.runs.reload import reload_data
from nerf_lightning.runs.scene_file import read_scene_file, save_scene
from nerf_lightning.synthetic.bricks import bricks
from tests.helpers.scene_writers import colmap_cameras, write_colmap, write_photos

URL = "http://stranger.example/published.npz"


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def asked(*_: Any, **__: Any) -> None:
        raise AssertionError("the network was asked")

    monkeypatch.setattr(urllib.request, "urlopen", asked)


def a_run(folder: Path, *overrides: str) -> Path:
    """What reading a run's photos needs of its folder."""
    small = ["+experiment=lego", f"dataset.url={URL}", "dataset.resize=16", "dataset.download=false", *overrides]
    cfg = compose_config(small, folder)
    save_scene(build_data(cfg), folder)
    cfg.dataset.download = True
    save_config(cfg, folder)
    return folder


def again(run: Path, photos: str | None = None) -> Any:
    return reload_data(load_config(run), read_scene_file(run), photos).scene


@pytest.fixture
def published(tmp_path: Path) -> Path:
    path = tmp_path / "data" / "published.npz"
    path.parent.mkdir()
    save_npz(bricks(size=16, train_views=4, val_views=2), path)
    return path


def test_reload_data_downloaded_scene_from_any_folder(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    run = a_run(tmp_path / "run", "dataset.folder=data")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert (again(run).name, again(run).sha256()) == ("published", again(run, str(published)).sha256())
    published.unlink()
    with pytest.raises(InputError, match=r"data/published\.npz.*no such file"):
        again(run)


def test_reload_data_built_in_scene_is_not_replaced_by_download(tmp_path: Path):
    run = a_run(tmp_path / "run", f"dataset.folder={tmp_path}")
    assert again(run).name == "bricks", "and the network is not asked"
    save_npz(bricks(size=16, train_views=4, val_views=2), tmp_path / "published.npz")
    with pytest.raises(InputError, match="found the scene 'published', expected 'bricks', which the run was trained"):
        again(run)
    assert again(run, str(tmp_path / "published.npz")).name == "published"


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (5e5, 5.4112e6, 300.0)], ids=["local", "georeferenced"])
def test_reload_data_other_photos_are_in_frame_of_run(shift: tuple[float, float, float], tmp_path: Path):
    """Half of a capture has another middle and another scale than all of it; its cameras still stand where they stood."""
    whole = bricks(size=16, train_views=12, val_views=2)
    views: Views = whole.train

    def capture(name: str, chosen: list[int]) -> str:
        some = views[torch.tensor(chosen)]
        names = [f"{i:04d}.png" for i in chosen]
        for old, new in zip(write_photos(tmp_path / name / "images", some, first=100), names, strict=True):
            (tmp_path / name / "images" / old).rename(tmp_path / name / "images" / new)
        c2w = some.cameras.c2w.double()
        c2w[:, :3, 3] += torch.tensor(shift, dtype=torch.float64)
        write_colmap(tmp_path / name / "sparse/0", c2w.numpy(), names, colmap_cameras(some))
        return str(tmp_path / name)

    cfg = compose_config(["dataset=photos", f"dataset.path={capture('all', list(range(12)))}"], tmp_path / "run")
    data = build_data(cfg)
    (tmp_path / "run").mkdir()
    save_scene(data, tmp_path / "run")
    save_config(cfg, tmp_path / "run")
    same, half = again(tmp_path / "run"), again(tmp_path / "run", capture("half", list(range(1, 8))))
    assert torch.equal(same.train.cameras.c2w, data.scene.train.cameras.c2w)
    at = [data.scene.train.names.index(name) for name in half.train.names]
    torch.testing.assert_close(half.train.cameras.c2w, data.scene.train.cameras.c2w[at], atol=1e-4, rtol=0)
    assert torch.equal(half.bounds.aabb, data.scene.bounds.aabb) and torch.equal(half.to_source, data.scene.to_source)
