"""nerf_lightning view: the page about a scene, its server, and what a path is taken for."""

import functools
import http.client
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.cli.view import has_run, view
from nerf_lightning.dataset import Scene, Views, save_npz
from nerf_lightning.errors import InputError
from nerf_lightning.view.geometry import color_points
from nerf_lightning.view.scene_page import ScenePage
from nerf_lightning.view.serve import announce, resolve_host

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def page(scene: Scene) -> Iterator[ScenePage]:
    page = ScenePage(scene, "127.0.0.1", 0)
    yield page
    page.stop()


def test_scene_page_shows_cameras_and_no_rays(page: ScenePage, scene: Scene):
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=10)
    connection.request("GET", "/")
    response = connection.getresponse()
    assert response.status == 200
    assert b"<html" in response.read()
    connection.close()
    nodes = page.server.scene.get_handle_by_name
    for group, views in (("training", scene.train), ("held_out", scene.val)):
        for i, c2w in enumerate(views.cameras.c2w.numpy()):
            handle = nodes(f"/{group}/{i}")
            np.testing.assert_allclose(handle.position, c2w[:3, 3])
            w, x, y, z = handle.wxyz
            third = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
            np.testing.assert_allclose(third, c2w[:3, 2], atol=1e-5)  # z looks ahead, as OpenCV has it
    for name in ("/orbit", "/box", "/focus", "/axes"):
        assert nodes(name).visible
    assert not nodes("/rays").visible and nodes("/rays/approach") is None


def test_scene_page_controls_change_what_is_shown(page: ScenePage):
    nodes = page.server.scene.get_handle_by_name
    page.rays.value, page.samples.value = 1, 7
    page.draw_rays()
    first = nodes("/rays/approach").points.copy()
    assert first.shape == (4, 2, 3)
    page.draw_rays()
    assert np.array_equal(nodes("/rays/approach").points, first)
    page.draw_rays(again=True)
    assert not np.array_equal(nodes("/rays/approach").points, first)
    assert len(nodes("/rays/samples").points) == 7 * len(nodes("/rays/inside").points)
    page.rays.value = 0
    page.draw_rays()
    assert not nodes("/rays").visible
    size = nodes("/training/0").scale
    page.depth.value = 2 * page.depth.value
    page.size_frusta()
    assert nodes("/training/0").scale == pytest.approx(2 * size)
    page.photos.value = False
    page.show_photos()
    assert nodes("/training/0").image is None


def test_color_points_use_nearest_photo(scene: Scene):
    images = torch.zeros(4, 16, 16, 3, dtype=torch.uint8)
    images[:] = torch.tensor([10, 20, 30, 40])[:, None, None, None]
    views = Views.from_images(images, scene.train.cameras)
    c2w = scene.train.cameras.c2w
    near = c2w[2, :3, 3] + 0.5 * c2w[2, :3, 2]
    behind = scene.train.cameras.centers.mean(0) + 1e3 * torch.tensor([0.0, 0.0, 1.0])
    points, rgb = color_points(torch.stack([near, behind]), views)
    np.testing.assert_allclose(points[0], near)
    assert rgb.tolist() == [[30] * 3, [128] * 3]


def test_view_without_viser_names_the_extra(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'nerf_lightning\[view\]'"):
        view(Path("any.npz"))


def test_announce_names_visibility_and_rejects_foreign_address():
    for host in ("192.0.2.1", ""):
        with pytest.raises(InputError, match="127.0.0.1 for this machine alone"):
            resolve_host(host)
    assert announce("lego", "127.0.0.1", 8080, 8080) == "lego: http://127.0.0.1:8080"
    assert announce("lego", "localhost", 8080, 8081).endswith("http://localhost:8081 (port 8080 is taken)")
    assert "http://127.0.0.1:9000; shared with the network" in announce("lego", "0.0.0.0", 0, 9000)


def test_has_run_distinguishes_runs_from_scenes(scene: Scene, small_run: Path, tmp_path: Path):
    save_npz(scene, tmp_path / "scene.npz")
    shutil.copytree(small_run, tmp_path / "runs" / "first")
    shutil.copytree(small_run, tmp_path / "photos" / "outputs" / "first")
    (tmp_path / "photos" / "transforms.json").touch()
    np.savez(tmp_path / "compact.npz", header=np.zeros(3, np.uint8))
    (tmp_path / "damaged.npz").write_bytes((tmp_path / "scene.npz").read_bytes()[:-30])
    expected = {"scene.npz": False, "runs": True, "runs/first": True, "photos": False, "compact.npz": True}
    expected |= {"damaged.npz": False, "nowhere": False}
    assert {name: has_run(tmp_path / name) for name in expected} == expected


def test_view_ctrl_c_writes_nothing(scene: Scene, tmp_path: Path):
    save_npz(scene, tmp_path / "small.npz")
    code = "from nerf_lightning.cli.app import main; main()"
    called = [sys.executable, "-c", code, "view", "small.npz", "--port", "0"]
    # What runs in the background may ignore it.
    listen = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(called, cwd=tmp_path, env=environment, preexec_fn=listen, **pipes)
    try:
        line = next(line for line in process.stdout if "http" in line)
        assert line.startswith("small: http://127.0.0.1:"), line
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode in (0, 130)
    assert list(tmp_path.iterdir()) == [tmp_path / "small.npz"]
