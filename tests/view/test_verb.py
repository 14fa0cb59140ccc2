"""The page about a scene: the server, its controls, and the command line."""

import functools
import http.client
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nerf_lightning.dataset import Scene, save_npz
from nerf_lightning.errors import InputError
from nerf_lightning.view.__main__ import main
from nerf_lightning.view.serve import announcement, find_port

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def page(scene: Scene) -> Iterator:
    pytest.importorskip("viser", reason="viser is not installed")
    from nerf_lightning.view.scene_page import ScenePage

    page = ScenePage(scene, "127.0.0.1", find_port("127.0.0.1", 0)[1], 8, 5, 7)
    yield page
    page.stop()


def test_the_page_is_served_and_shows_the_scene(page, scene: Scene):
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
    assert nodes("/rays/approach").points.shape == (4, 2, 3)
    for name in ("/orbit", "/box", "/focus", "/axes"):
        assert nodes(name).visible


def test_controls_change_what_is_shown(page):
    nodes = page.server.scene.get_handle_by_name
    first = nodes("/rays/approach").points.copy()
    page.draw_rays()
    assert np.array_equal(nodes("/rays/approach").points, first)
    page.draw_rays(again=True)
    assert not np.array_equal(nodes("/rays/approach").points, first)
    page.which.value = "many rays from one camera"
    page.camera.value = 3
    page.draw_rays()
    centre = page.scene.train.cameras.centres[3].numpy()
    np.testing.assert_allclose(nodes("/rays/approach").points[:, 0], np.tile(centre, (5, 1)))
    assert len(nodes("/rays/samples").points) == 7 * len(nodes("/rays/inside").points)
    page.which.value = "none"
    page.draw_rays()
    assert not nodes("/rays").visible
    size = nodes("/training/0").scale
    page.depth.value = 2 * page.depth.value
    page.size_frusta()
    assert nodes("/training/0").scale == pytest.approx(2 * size)
    page.photos.value = False
    page.show_photos()
    assert nodes("/training/0").image is None


def test_a_missing_viser_is_said_in_one_line(verb, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    code, _, err = verb(main, "scene=any.npz")
    assert code == 2 and "pip install 'nerf_lightning[view]'" in err and err.count("\n") == 1


def test_a_taken_port_gives_the_next_and_a_strange_host_a_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        address, found = find_port("127.0.0.1", port)
        assert address == "127.0.0.1"
        assert found > port
    for host in ("192.0.2.1", "", "no such host"):
        with pytest.raises(InputError, match="127.0.0.1 for this machine alone"):
            find_port(host, 0)


def test_the_line_says_who_can_see_the_page():
    assert announcement("lego", "127.0.0.1", "127.0.0.1", 8080, 8080) == "lego: http://127.0.0.1:8080; Ctrl-C ends it"
    assert "http://localhost:8081 (port 8080 is taken);" in announcement("lego", "localhost", "127.0.0.1", 8080, 8081)
    shared = announcement("lego", "0.0.0.0", "0.0.0.0", 0, 9000)
    assert "http://127.0.0.1:9000; shared with the network (host=0.0.0.0)" in shared


def test_ctrl_c_ends_it_cleanly_and_nothing_is_written(scene: Scene, tmp_path: Path):
    pytest.importorskip("viser", reason="viser is not installed")
    save_npz(scene, tmp_path / "small.npz")
    called = [sys.executable, "-m", "nerf_lightning.view", "scene=small.npz", "port=0"]
    # What runs in the background may ignore it.
    listen = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(called, cwd=tmp_path, env=environment, preexec_fn=listen, **pipes)
    try:
        line = next(line for line in process.stdout if not line.startswith("INFO"))
        assert line.startswith("small: http://127.0.0.1:"), line
    finally:
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "")
    assert list(tmp_path.iterdir()) == [tmp_path / "small.npz"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["scene and run", "nothing", "give scene=scene.npz or run=DIR"]),
        (["scene=a.npz", "run=b"], ["scene and run", "found both"]),
        (["run=nowhere", "port=0"], ["nowhere/config.yaml", "nothing there"]),
        (["scene=a.npz", "rays=0"], ["rays", "found 0", "at least 1"]),
        (["scene=a.npz", "+ray=3"], ["ray", "unknown option", "did you mean rays?"]),
        (["scene=missing.npz", "port=0"], ["missing.npz", "nothing there"]),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_2(verb, arguments: list[str], words: list[str], tmp_path: Path):
    pytest.importorskip("viser", reason="viser is not installed")
    code, _, err = verb(main, *arguments)
    assert code == 2
    assert err.count("\n") == 1, err
    for word in words:
        assert word in err
    assert not list(tmp_path.iterdir())
