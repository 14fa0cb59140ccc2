"""The page about a scene: what is drawn against the scene's own geometry, the server, and the command line."""

import functools
import http.client
import math
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras, Rays, pixel_to_camera, transform
from nerf_lightning.dataset import Scene, Views, save_npz
from nerf_lightning.dataset.bricks.scene import bricks
from nerf_lightning.errors import InputError
from nerf_lightning.view.__main__ import main
from nerf_lightning.view.drawing import (
    box_edges,
    frusta,
    overview,
    path_segments,
    random_rays,
    ray_figure,
    through,
)
from nerf_lightning.view.serve import announcement, find_port

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return bricks(size=16, train_views=4, val_views=2, orbit_views=6, cache="")


def some(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def off_centre(views: Views) -> Views:
    """The same photos through a lens whose axis meets them 2 pixels right of and 4 above the middle; no square pixels."""
    K = torch.tensor([[20.0, 0.0, 10.0], [0.0, 25.0, 4.0], [0.0, 0.0, 1.0]])
    return replace(views, cameras=replace(views.cameras, K=K.expand_as(views.cameras.K)))


def test_frusta_stand_where_the_cameras_are(scene: Scene):
    drawn = list(frusta(scene.train, "training", 8))
    assert [f.name for f in drawn] == ["training 0", "training 1", "training 2", "training 3"]
    for frustum, c2w, K in zip(drawn, scene.train.cameras.c2w, scene.train.cameras.K, strict=True):
        assert np.array_equal(frustum.c2w, c2w.numpy())
        assert frustum.fov == pytest.approx(2 * math.atan(8 / float(K[1, 1])))
        assert frustum.aspect == pytest.approx(1)
        assert frustum.photo.shape == (8, 8, 4)


@pytest.mark.parametrize("channels", [3, 4])
def test_a_photo_stays_in_place_when_the_optical_axis_is_not_its_middle(scene: Scene, channels: int):
    """Every pixel of the photo lies in the pyramid's base where the camera's own K puts it."""
    views = off_centre(Views(scene.train.images[..., :channels].contiguous(), scene.train.cameras))
    frustum = next(frusta(views, "training", 16))
    h, w, _ = frustum.photo.shape
    assert (h, w) == (16 + 8, 16 + 4)
    assert np.array_equal(frustum.photo[8:, :16, :channels], views.images[0].numpy())
    assert not frustum.photo[:8].any() and not frustum.photo[:, 16:].any()
    down = math.tan(frustum.fov / 2)
    across = down * frustum.aspect
    row, col = 3, 5
    expected = pixel_to_camera(views.cameras.K[0], torch.tensor([col + 0.5, row + 0.5]), torch.ones(()))
    at = ((2 * (col + 0.5) / w - 1) * across, (2 * (row + 8 + 0.5) / h - 1) * down, 1)
    assert at == pytest.approx(expected.tolist(), abs=1e-6)


def pixel_of(cameras: Cameras, view: int, rays: Rays) -> torch.Tensor:
    """Where a view sees points a unit down its rays; continuous pixels [R, 2]."""
    points = rays.origins + rays.directions
    local = transform(torch.linalg.inv(cameras.c2w[view]), points)
    projected = local @ cameras.K[view].T
    return projected[:, :2] / projected[:, 2:]


def test_rays_start_at_the_centres_and_pass_through_pixel_centres(scene: Scene):
    cameras = off_centre(scene.train).cameras
    views = torch.arange(len(cameras)).repeat_interleave(50)
    rays = random_rays(cameras, views, some())
    assert torch.equal(rays.origins, cameras.centres[views])
    for view in range(len(cameras)):
        pixels = pixel_of(cameras, view, rays[views == view])
        torch.testing.assert_close(pixels - 0.5, (pixels - 0.5).round(), atol=1e-4, rtol=0)
        assert pixels.min() > 0 and pixels.max() < 16
        assert len(pixels.round(decimals=1).unique(dim=0)) > 30


@pytest.mark.parametrize("jitter", [False, True])
def test_samples_lie_on_their_rays_within_the_box(scene: Scene, jitter: bool):
    rays = random_rays(scene.train.cameras, torch.full((40,), 1), some())
    figure = ray_figure(rays, scene.bounds, 16, 4.0, some() if jitter else None)
    assert len(figure.approach) == 40
    assert np.array_equal(figure.approach[:, 0], rays.origins.numpy())
    hits = len(figure.inside)
    assert 0 < hits <= 40
    assert figure.samples.shape == (16 * hits, 3)
    low, high = scene.bounds.aabb.numpy()
    assert (figure.samples > low - 1e-4).all() and (figure.samples < high + 1e-4).all()
    for ends, points in zip(figure.inside, figure.samples.reshape(hits, 16, 3), strict=True):
        along = (points - ends[0]) @ (ends[1] - ends[0]) / np.sum((ends[1] - ends[0]) ** 2)
        np.testing.assert_allclose(points, ends[0] + along[:, None] * (ends[1] - ends[0]), atol=1e-5)
        assert (np.diff(along) > 0).all() and along[0] > 0 and along[-1] < 1
        assert jitter != np.allclose(along, (np.arange(16) + 0.5) / 16, atol=1e-4)


def test_rays_that_miss_the_box_end_in_a_stump_without_samples():
    rays = Rays(torch.tensor([[0.0, 0.0, -5.0], [0.0, 0.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    box = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    figure = ray_figure(rays, box, 3, 2.5, None)
    np.testing.assert_allclose(figure.approach, [[[0, 0, -5], [0, 0, -1]], [[0, 0, -5], [0, 2.5, -5]]])
    np.testing.assert_allclose(figure.inside, [[[0, 0, -1], [0, 0, 1]]])
    np.testing.assert_allclose(figure.samples, [[0, 0, -2 / 3], [0, 0, 0], [0, 0, 2 / 3]], atol=1e-6)


def test_box_edges_are_the_box():
    edges = box_edges(torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]))
    along = np.abs(edges[:, 1] - edges[:, 0])
    assert sorted(along.sum(1).tolist()) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4
    assert ((along > 0).sum(1) == 1).all()
    assert len(np.unique(edges.reshape(-1, 3), axis=0)) == 8


def test_a_ring_is_drawn_closed_and_a_sweep_open(scene: Scene):
    ring = path_segments(scene.orbit)
    assert len(ring) == 6
    assert np.array_equal(ring[-1, 1], ring[0, 0])
    assert len(path_segments(scene.orbit[:3])) == 2
    assert path_segments(scene.orbit[:1]).shape == (0, 2, 3)


def test_the_first_look_has_all_cameras_and_the_box_in_sight(scene: Scene):
    view = overview(scene)
    ahead = view.look_at - view.position
    ahead /= np.linalg.norm(ahead)
    np.testing.assert_allclose(view.up, [0, 0, 1], atol=1e-5)
    for point in torch.cat([scene.train.cameras.centres, scene.val.cameras.centres, scene.bounds.aabb]).numpy():
        toward = point - view.position
        assert toward @ ahead / np.linalg.norm(toward) >= math.cos(view.fov / 2) - 1e-6


def test_looking_through_a_frustum_is_looking_as_its_camera_did(scene: Scene):
    frustum = next(frusta(scene.train, "training", 8))
    view = through(frustum, 4.0, np.array([0.0, 0.0, 1.0], np.float32))
    right, down, ahead, centre = scene.train.cameras.c2w[0, :3].T.numpy()
    np.testing.assert_allclose(view.position, centre)
    np.testing.assert_allclose(view.look_at, centre + 4 * ahead, rtol=1e-6)
    assert abs(view.up @ right) < 1e-6  # no roll
    assert view.up @ down < 0
    np.testing.assert_allclose(through(frustum, 4.0, down).up, -down)  # taken upside down


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
        line = process.stdout.readline()
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
        (["run=nowhere", "port=0"], ["nowhere/config.yaml", "no such file"]),
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
