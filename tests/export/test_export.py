"""nerf_lightning export, on a run of seconds."""

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from nerf_lightning.cli.export import (
    export_compact,
    export_html,
    export_mesh,
    export_points,
    export_transforms,
    export_voxels,
)
from nerf_lightning.config.compose import compose_config
from nerf_lightning.errors import InputError
from nerf_lightning.training.train import train
from tests.helpers.run_results import make_results


def read_about(page: Path) -> dict[str, Any]:
    """What the page knows besides its field."""
    found = re.search(r'<script type="application/json" id="about">(.*?)</script>', page.read_text("utf-8"), re.S)
    assert found
    return json.loads(found[1])


@pytest.fixture(scope="module")
def planes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of a field that a page draws as it is."""
    folder = tmp_path_factory.mktemp("planes")
    size = ["dataset.size=16", "dataset.train_views=8", "dataset.val_views=1", "dataset.rays=64"]
    train(
        compose_config(["recipe=tensorf_small", *size, "budget.steps=10", "callbacks.orbit.frames=4"], folder),
        folder=folder,
    )
    return folder


@pytest.fixture
def sweep(planes: Path, tmp_path: Path) -> Path:
    """A folder with a run, a copy of it, and one that never finished."""
    for name in ("a=1,b=2", "second"):
        shutil.copytree(planes, tmp_path / "sweep" / name)
    broken = tmp_path / "sweep" / "broken"
    broken.mkdir()
    (broken / "config.yaml").write_text((planes / "config.yaml").read_text())
    (broken / "results.json").write_text(json.dumps(make_results(status="interrupted")))
    return tmp_path / "sweep"


def test_export_html_of_a_run_and_of_its_compact_file(planes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = shutil.copytree(planes, tmp_path / "run")
    page = export_html(run, max_psnr_drop=3.0, device="cpu")
    assert page == run / "field.html" and "held-out PSNR" in capsys.readouterr().out
    about = read_about(page)
    facts = dict(about["facts"])
    assert facts["held-out PSNR"].endswith(" dB") and facts["training"].endswith("10 steps")
    assert len(about["photos"]["names"]) > 1
    compact = export_compact(run, max_psnr_drop=3.0, device="cpu")
    alone = read_about(export_html(compact, output=tmp_path / "alone.html"))
    assert "without photos" in capsys.readouterr().out
    assert alone["photos"] is None and alone["orbit"] == about["orbit"]


def test_export_html_all_writes_gallery(sweep: Path, capsys: pytest.CaptureFixture[str]):
    gallery = export_html(sweep, all=True, max_psnr_drop=3.0, device="cpu")
    out = capsys.readouterr().out
    assert "left out: " in out and "2 fields side by side" in out
    assert re.findall(r'<iframe sandbox="allow-scripts"[^>]* src="([^"]*)"', gallery.read_text("utf-8")) == [
        "a%3D1%2Cb%3D2/field.html",
        "second/field.html",
    ]
    before = (sweep / "second/field.html").stat().st_mtime_ns
    export_html(sweep, all=True, max_psnr_drop=3.0, device="cpu")
    assert (sweep / "second/field.html").stat().st_mtime_ns == before, "a page that is there is kept"


def test_export_writes_format_of_suffix(planes: Path, tmp_path: Path):
    box = (-9.0, -9.0, -9.0, 9.0, 9.0, 9.0)
    given: dict[str, Any] = {"resolution": 12, "device": "cpu"}
    mesh = export_mesh(planes, output=tmp_path / "it's a mesh, (1).glb", threshold=0.001, box=box, **given)
    points = export_points(planes, output=tmp_path / "points.ply", threshold=0.001, **given)
    voxels = export_voxels(planes, output=tmp_path / "voxels.npz", **given)
    assert mesh.read_bytes()[:4] == b"glTF" and points.read_bytes()[:3] == b"ply" and voxels.read_bytes()[:2] == b"PK"
    posed = export_transforms(planes, output=tmp_path / "posed")
    assert len(json.loads((posed / "transforms.json").read_text())["frames"]) == 9
    with pytest.raises(InputError, match="posed: exists already"):
        export_transforms(planes, output=posed)


@pytest.mark.parametrize(
    ("export", "given", "message"),
    [
        (export_mesh, {"output": Path("mesh.fbx")}, "output: found mesh.fbx"),
        (export_mesh, {"threshold": 1.0}, "threshold: found 1"),
        (export_mesh, {"box": (0, 0, 0, 1, -1, 1)}, "box: found 0 0 0 1 -1 1"),
    ],
)
def test_export_bad_options_raise(export: Any, given: dict[str, Any], message: str, planes: Path):
    before = sorted(planes.rglob("*"))
    with pytest.raises(InputError, match=message):
        export(planes, **given)
    assert sorted(planes.rglob("*")) == before


def test_export_mesh_without_trimesh_names_the_extra(planes: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(InputError, match=r"pip install 'nerf_lightning\[mesh\]'"):
        export_mesh(planes)
