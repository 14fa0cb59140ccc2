"""Plausibility checks raise or warn for bad scenes, and accept good ones."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds
from nerf_lightning.dataset import Scene, Views, load_npz, save_npz, scene_checks
from nerf_lightning.dataset.scene_bounds import find_border_color
from nerf_lightning.dataset.scene_checks import check_bounds, check_scene
from nerf_lightning.dataset.scene_kind import check_visible_pixels
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.synthetic.corruptions import flip_axes, map_poses, shuffle_poses
from nerf_lightning.synthetic.objects import MARBLE, PILE, ROD, make_object_scene

WHITE = (1.0, 1.0, 1.0)
Change = Callable[[Scene], Scene]


def set_near_far(near: float | None, far: float | None) -> Change:
    return lambda scene: replace(scene, bounds=replace(scene.bounds, near=near, far=far))


@pytest.fixture(scope="module")
def pile() -> Scene:
    return make_object_scene(PILE, size=32)


@pytest.mark.parametrize(
    "scene",
    [
        lambda: make_object_scene(PILE, size=32),
        lambda: make_object_scene(PILE, None, size=32),
        lambda: make_object_scene(ROD, WHITE, size=32),
        lambda: bricks(size=32, train_views=12, val_views=2),
    ],
    ids=["pile", "alpha", "rod", "bricks"],
)
def test_check_scene_good_scene_has_no_issue(scene: Callable[[], Scene]):
    assert check_scene(scene()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda scene: flip_axes(scene, 0), "axes of the other convention"),
        (lambda scene: replace(scene, background=WHITE), "differs from the stated background"),
        (set_near_far(0.2, 0.6), "far=0.6 clips"),
        (lambda scene: replace(scene, bounds=Bounds(0.2 * scene.bounds.aabb)), "outside the box"),
    ],
    ids=["opengl", "flag", "far", "box"],
)
def test_check_scene_fatal_issue_raises(change: Change, words: str, pile: Scene):
    with pytest.raises(InputError, match=words):
        check_scene(change(pile))


@pytest.fixture
def no_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    """As for textureless photos."""
    monkeypatch.setattr(scene_checks, "compare_with_matches", lambda scene: ([], False))


@pytest.mark.usefixtures("no_matches")
def test_check_scene_without_matches_checks_silhouettes(pile: Scene):
    assert check_scene(pile) == []
    with pytest.raises(InputError, match="inconsistent silhouettes"):
        check_scene(flip_axes(pile, 0))
    (issue,) = check_scene(shuffle_poses(pile, 0))
    assert "inconsistent silhouettes" in issue.text and not issue.has_wrong_poses


@pytest.mark.usefixtures("no_matches")
def test_check_scene_cameras_looking_away_warn(pile: Scene):
    away = flip_axes(replace(pile, bounds=Bounds(pile.bounds.aabb, unbounded=True)), 0)
    (issue,) = check_scene(away)
    assert "cameras that look away" in issue.text and not issue.is_fatal


def make_black(scene: Scene) -> Scene:
    return replace(scene, train=replace(scene.train, pixels=torch.zeros_like(scene.train.pixels)))


def make_identical(scene: Scene) -> Scene:
    images = scene.train.images[:1].repeat(len(scene.train), 1, 1, 1)
    images[1::2, ::5] ^= 1  # noise
    return replace(scene, train=Views.from_images(images, scene.train.cameras))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda scene: replace(scene, train=scene.train[torch.tensor([3])]), "one photo to train on"),
        (make_black, "identical"),
        (make_identical, "identical"),
    ],
    ids=["one", "black", "identical"],
)
def test_check_scene_empty_data_raises(change: Change, words: str, pile: Scene):
    with pytest.raises(InputError, match=words):
        check_scene(change(pile), refines_poses=True)


def test_check_scene_suspect_scene_warns(pile: Scene):
    (issue,) = check_scene(set_near_far(3.6, None)(pile))
    assert "near=3.6 clips" in issue.text
    assert check_scene(set_near_far(0.1, 40.0)(pile)) == [], "wider than the box: the box decides"

    twice = map_poses(pile.train, lambda c2w: c2w[[0, 1, 2, 3, 4, 4, *range(6, 24)]])
    (issue,) = check_scene(replace(pile, train=twice))
    assert "1 of 24 training photos have the pose of another" in issue.text

    images, poses = pile.val.images.clone(), pile.val.cameras.c2w.clone()
    images[1], poses[1] = pile.train.images[7], pile.train.cameras.c2w[7]
    leaked = replace(pile, val=Views.from_images(images, replace(pile.val.cameras, c2w=poses)))
    (issue,) = check_scene(leaked)
    assert "1 of 4 held-out photos are trained on as well" in issue.text


def test_check_visible_pixels_empty_views_raise(pile: Scene):
    views = pile.train
    transparent = replace(views, pixels=torch.cat([views.pixels, 0 * views.pixels[:, :1]], dim=1))
    for hidden in (transparent, replace(views, valid_mask=torch.zeros(len(views.pixels), dtype=torch.bool))):
        with pytest.raises(InputError, match="remove every pixel of the training photos"):
            check_visible_pixels("photos", hidden)


def test_find_border_color_is_the_background(pile: Scene, tmp_path: Path):
    assert find_border_color(pile.train) == (0.0, 0.0, 0.0)
    assert find_border_color(make_object_scene(PILE, None, size=32).train) is None
    path = tmp_path / "white.npz"
    save_npz(make_object_scene(MARBLE, WHITE, size=32), path)
    arrays = dict(np.load(path))
    assert arrays.pop("background").tolist() == [1, 1, 1]
    np.savez(path, **arrays)
    assert load_npz(path).background == WHITE, "also where the file does not say"


def test_check_bounds_box_off_the_subject_warns(pile: Scene):
    aside = replace(pile.bounds, aabb=pile.bounds.aabb + torch.tensor([3.0, 0, 0]))
    (text,) = (issue.text for issue in check_bounds(replace(pile, bounds=aside)))
    assert "cameras look at a point 3 from the box center" in text
    tiny = replace(pile.bounds, aabb=0.1 * pile.bounds.aabb, unbounded=True)
    (text,) = (issue.text for issue in check_bounds(replace(pile, bounds=tiny)))
    assert "half-sizes" in text
    assert not list(check_bounds(replace(pile, bounds=replace(pile.bounds, unbounded=True))))
