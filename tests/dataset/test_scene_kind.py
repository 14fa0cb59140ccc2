"""Classification into bounded and unbounded scenes, equal for every file format."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerf_lightning.cameras import transform_poses
from nerf_lightning.dataset import PhotoLoadOptions, Scene, Views, open_scene, save_npz
from nerf_lightning.errors import InputError
from tests.helpers.scene_writers import write_scene

FORMATS = ("npz", "blender", "transforms", "colmap", "llff")


@pytest.fixture(scope="session")
def ball_views(ball_views_of: Callable[..., Views]) -> Views:
    return ball_views_of(4)


def with_background(views: Views, alpha: int | None) -> Views:
    """Photos on noise, without alpha or with a constant one."""
    noise = torch.randint(0, 255, (len(views.pixels), 3), generator=torch.Generator().manual_seed(0))
    rgb = torch.where(views.pixels[:, 3:] > 0, views.pixels[:, :3], noise).to(torch.uint8)
    if alpha is None:
        return replace(views, pixels=rgb)
    return replace(views, pixels=torch.cat([rgb, torch.full_like(rgb[:, :1], alpha)], dim=1))


def on_color(views: Views, color: int) -> Views:
    alpha = views.pixels[:, 3:].float() / 255
    return replace(views, pixels=(views.pixels[:, :3] * alpha + color * (1 - alpha)).round().to(torch.uint8))


def with_margin(views: Views) -> Views:
    """Photos with a background and transparent margins, as left by undistortion."""
    views = with_background(views, 255)
    for view in range(len(views)):
        views.image(view)[[0, -1], :, 3] = 0
        views.image(view)[:, [0, -1], 3] = 0
    return views


SHOWN: dict[str, tuple[Callable[[Views], Views], bool, int, str]] = {
    "cut out": (lambda views: views, True, 4, "alpha cuts the subject out"),
    "on gray": (lambda views: on_color(views, 90), True, 3, "borders have one color"),
    "background": (lambda views: with_background(views, None), False, 3, "show a background"),
    "opaque alpha": (lambda views: with_background(views, 255), False, 3, "show a background"),
    "margins": (with_margin, False, 3, "show a background"),
}


@pytest.mark.parametrize(
    ("shown", "format"),
    [(shown, format) for shown in SHOWN for format in ("npz", "transforms")] + [("margins", "llff")],
)
def test_open_scene_kind_is_the_same_in_every_format(shown: str, format: str, ball_views: Views, tmp_path: Path):
    edit, bounded, channels, reason = SHOWN[shown]
    scene = open_scene(str(write_scene(format, tmp_path / "s", edit(ball_views))))
    assert scene.bounds.unbounded is not bounded and scene.train.channels == channels
    assert reason in scene.describe()["kind"] and scene.describe()["bounded"] is bounded
    if shown == "on gray":
        assert scene.background == pytest.approx((90 / 255,) * 3)
    if shown == "margins":
        assert not scene.train.view_mask(0)[0].any() and scene.train.view_mask(0)[1:-1, 1:-1].all()


@pytest.mark.parametrize("format", FORMATS)
def test_open_scene_frame_is_the_same_in_every_format(format: str, ball_views: Views, tmp_path: Path):
    views = with_background(ball_views, None)
    scene = open_scene(str(write_scene(format, tmp_path / "s", views)))
    assert float(scene.train.cameras.centers.norm(dim=1).median()) == pytest.approx(1, rel=0.02)
    torch.testing.assert_close(scene.bounds.aabb, torch.tensor([[-1.0] * 3, [1.0] * 3]))
    first = 3 if format in ("npz", "blender") else 1
    back = transform_poses(scene.train.cameras.c2w[:1], scene.to_source)[0].float()
    torch.testing.assert_close(back, views.cameras.c2w[first], atol=1e-4, rtol=0)


def test_open_scene_bounded_option_and_stated_box_rule(ball: Scene, ball_views: Views, tmp_path: Path):
    path = str(write_scene("transforms", tmp_path / "s", with_background(ball_views, None)))
    scene = open_scene(path, options=PhotoLoadOptions(bounded="true"))
    assert not scene.bounds.unbounded and "dataset.bounded=true" in scene.kind
    save_npz(replace(ball, bounds=replace(ball.bounds, unbounded=True)), tmp_path / "s.npz")
    scene = open_scene(str(tmp_path / "s.npz"))
    assert scene.bounds.unbounded and torch.equal(scene.bounds.aabb, ball.bounds.aabb) and "box" in scene.kind
    assert not open_scene(str(tmp_path / "s.npz"), options=PhotoLoadOptions(bounded="true")).bounds.unbounded


@pytest.mark.parametrize("format", ["npz", "blender", "transforms"])
def test_open_scene_options_reach_every_format(format: str, ball_views: Views, tmp_path: Path):
    path = write_scene(format, tmp_path / "s", ball_views)
    if format == "transforms":
        path = (path / "transforms.json").rename(path / "Other.json")
    scene = open_scene(str(path), options=PhotoLoadOptions(resize=24), name="mine", near=0.5, far=2.0)
    assert scene.name == "mine" and scene.resolution == (24, 20)
    assert scene.train.images.shape[1:3] == scene.val.images.shape[1:3] == (20, 24)
    assert (scene.orbit.width, scene.orbit.height) == (24, 20)
    K = torch.tensor([[30.0, 0, 12], [0, 30, 10], [0, 0, 1]])
    torch.testing.assert_close(scene.val.cameras.K[0], K)
    torch.testing.assert_close(scene.orbit.K[0], K)
    assert (scene.bounds.near, scene.bounds.far) == (0.5, 2.0)


def test_open_scene_unknown_path_raises(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.txt").write_text("")
    for name, found in (("absent", "no such file"), ("empty", "a folder without"), ("a.txt", "a .txt file without")):
        with pytest.raises(InputError, match=f"{tmp_path / name}: {found}.*; give photos or a video"):
            open_scene(str(tmp_path / name))
