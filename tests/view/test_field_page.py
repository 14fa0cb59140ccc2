"""The page about a field: what it paints for a browser that is played here, and the live view while training."""

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import viser
from viser.transforms import SO3

from nerf_lightning.cameras import Cameras, look_at, make_circle_poses
from nerf_lightning.config.compose import compose_config
from nerf_lightning.errors import InputError
from nerf_lightning.runs.folder import load_run
from nerf_lightning.training.train import train
from nerf_lightning.view.field_page import ClientState, FieldPage
from nerf_lightning.view.progressive import ProgressiveRenderer, ViewRequest
from tests.helpers.ball_runs import CENTER, RADIUS, make_ball_system

UP = torch.tensor([0.0, 0.0, 1.0])
BLUE = (0.0, 0.0, 1.0)


def orbit() -> Cameras:
    K = torch.tensor([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
    return Cameras.pinhole(K.repeat(4, 1, 1), make_circle_poses(CENTER, UP, 3.0, 0.3, 4), 32, 24)


def make_request(**changes: Any) -> ViewRequest:
    c2w = look_at(CENTER + torch.tensor([3.0, 0, 0]), CENTER, UP).double().numpy()
    given = {"c2w": c2w, "fov": 0.8, "aspect": 1.5, "channel": "rgb", "background": BLUE, "near": 0.0, "far": math.inf}
    return ViewRequest(**{**given, "max_side": 60, **changes})


@pytest.fixture(scope="module")
def painter() -> ProgressiveRenderer:
    return ProgressiveRenderer(make_ball_system(), orbit())


def test_progressive_renderer_matches_system(painter: ProgressiveRenderer):
    picture = painter.render(make_request(), 60, lambda: True)
    assert picture is not None and picture.shape == (40, 60, 3)
    cameras = make_request().cameras(60)
    assert (cameras.width, cameras.height) == (60, 40)
    expected = painter.system.render(cameras.generate_view_rays(0), background=BLUE).rgb.view(40, 60, 3).numpy()
    assert np.abs(picture / 255 - expected).max() <= 0.5 / 255 + 1e-6
    assert picture[0, 0].tolist() == [0, 0, 255]
    # A ball of radius r at distance d covers a circle of the radius f r / sqrt(d^2 - r^2).
    focal = 20 / math.tan(0.4)
    opacity = painter.render(make_request(channel="opacity", background=(0.0, 0.0, 0.0)), 60, lambda: True)
    assert opacity is not None
    covered = math.sqrt(float((opacity[..., 0] / 255.0).sum()) / math.pi)
    assert covered == pytest.approx(focal * RADIUS / math.sqrt(9 - RADIUS**2), rel=0.08)


def test_progressive_renderer_near_and_far_clip(painter: ProgressiveRenderer):
    whole, behind, before = (
        painter.render(make_request(channel="depth", background=(0.0, 0.0, 0.0), **cut), 60, lambda: True)
        for cut in ({}, {"near": 3.0}, {"far": 3.0 - RADIUS - 0.2})
    )
    assert whole is not None and behind is not None and before is not None
    assert behind[20, 30].sum() < whole[20, 30].sum(), "the back of the ball is farther, so darker"
    assert behind[20, 30].any() and not before[15:25, 20:40].any()


class Browser(viser.ClientHandle):
    """What Viser knows of one, with a camera that a test moves and the pictures it got."""

    def __init__(self) -> None:
        self.client_id = 7
        c2w = make_request().c2w
        self.pictures: list[np.ndarray] = []
        pose = {"wxyz": SO3.from_matrix(c2w[:3, :3]).wxyz, "position": c2w[:3, 3]}
        self.camera = SimpleNamespace(**pose, fov=0.8, aspect=1.5, on_update=lambda call: None)
        self.scene = SimpleNamespace(set_background_image=lambda image, **_: self.pictures.append(image))


@pytest.fixture
def page() -> Iterator[FieldPage]:
    page = FieldPage("ball", make_ball_system(), orbit(), None, "127.0.0.1", 0, 96, live=True)
    yield page
    page.stop()


def test_field_page_sends_coarse_then_finer_images_then_rests(page: FieldPage):
    browser = Browser()
    assert not page.render_next()
    page._add_client(browser)
    page.painter.rays_per_second = 24 * 24 / 0.08
    while page.render_next():
        page.painter.rays_per_second = 24 * 24 / 0.08
    sides = [picture.shape[1] for picture in browser.pictures]
    assert sides[0] < 40 and sides[-1] == 96 and sides == sorted(set(sides))
    page.background.value = "white"
    page._request_images()
    assert page.render_next()
    assert browser.pictures[-1][0, 0].tolist() == [255, 255, 255]
    page._remove_client(browser)
    assert not page.render_next()


def test_field_page_click_shows_the_samples_of_its_ray(page: FieldPage):
    page.click((3.0, -0.2, 0.05), (-2.0, 0.0, 0.0))
    page.render_next()
    points = page.server.scene.get_handle_by_name("/ray/samples").points
    np.testing.assert_allclose(points[:, 1:], np.tile([-0.2, 0.05], (len(points), 1)), atol=1e-5)
    assert (np.diff(points[:, 0]) < 0).all() and abs(points[:, 0]).max() <= 1.0
    assert f"depth {3 - 0.1 - RADIUS:.1f}" in page.status.content and "opacity 1.00" in page.status.content


SMALL = ["+experiment=smoke_3d", "dataset.size=16", "budget.steps=12", "callbacks.orbit=null", "threads=1", "~logger"]


def test_live_shows_progress_and_does_not_change_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    browser, reports = Browser(), []
    show = FieldPage.show_progress

    def with_browser(self: FieldPage, share: float, words: str) -> None:
        reports.append((share, words))
        show(self, share, words)
        if "done" in words:  # the browser gets one more image, and closes the page
            browser.scene.set_background_image = lambda *args, **given: self._remove_client(browser)

    welcomed = FieldPage.__init__

    def welcome(self: FieldPage, *given: Any, **more: Any) -> None:
        welcomed(self, *given, **more)
        self.clients[browser.client_id] = ClientState(browser)

    monkeypatch.setattr(FieldPage, "__init__", welcome)
    monkeypatch.setattr(FieldPage, "show_progress", with_browser)
    given = [*SMALL, "callbacks=live", "callbacks.live.port=0", "callbacks.live.max_time_fraction=0.9"]
    train(compose_config(given, tmp_path / "live"))
    assert browser.pictures
    assert 0 < reports[0][0] < 1 and reports[0][1].startswith("step ")
    assert reports[-1][0] == 1 and "training is done: held out" in reports[-1][1]
    train(compose_config(SMALL, tmp_path / "alone"))
    live, alone = (load_run(tmp_path / name).system.state_dict() for name in ("live", "alone"))
    assert all(torch.equal(live[key], alone[key]) for key in alone)


def test_live_image_run_raises(tmp_path: Path):
    flat = ["+experiment=smoke_2d", "dataset.max_side=16", "budget.steps=2", "callbacks.orbit=null", "~logger"]
    with pytest.raises(InputError, match="callbacks: live needs"):
        train(compose_config([*flat, "callbacks=live"], tmp_path / "b"))
