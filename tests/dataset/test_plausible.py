"""Data that cannot work is told before training; data that can is left alone."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from nerf_lightning.cameras import Bounds
from nerf_lightning.dataset import Scene, Views, plausible
from nerf_lightning.dataset.kind import check_visible
from nerf_lightning.dataset.plausible import check_scene
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.synthetic.corruptions import change_poses, flip_axes, shuffle_poses
from nerf_lightning.synthetic.objects import PILE, ROD, make_scene

WHITE = (1.0, 1.0, 1.0)
Change = Callable[[Scene], Scene]


def limited(near: float | None, far: float | None) -> Change:
    return lambda scene: replace(scene, bounds=replace(scene.bounds, near=near, far=far))


@pytest.fixture(scope="module")
def pile() -> Scene:
    return make_scene(PILE, size=32)


def test_check_scene_good_scene_has_no_doubt(pile: Scene):
    others = make_scene(PILE, None, size=32), make_scene(ROD, WHITE, size=32), bricks(32, 12, 2)
    assert [check_scene(scene) for scene in (pile, *others)] == [[]] * 4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda scene: flip_axes(scene, 0), "axes of the other convention"),
        (lambda scene: replace(scene, background=WHITE), "while the background is said to be"),
        (limited(0.2, 0.6), "far=0.6 cuts"),
        (lambda scene: replace(scene, bounds=Bounds(0.2 * scene.bounds.aabb)), "beyond the box"),
    ],
    ids=["opengl", "flag", "far", "box"],
)
def test_check_scene_hopeless_scene_raises(change: Change, words: str, pile: Scene):
    with pytest.raises(InputError, match=words):
        check_scene(change(pile))


@pytest.fixture
def no_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    """As between photos without texture."""
    monkeypatch.setattr(plausible, "judge_cameras", lambda scene: ([], False))


@pytest.mark.usefixtures("no_matches")
def test_check_scene_without_matches_judges_outlines(pile: Scene):
    assert check_scene(pile) == []
    with pytest.raises(InputError, match="outlines that no body has"):
        check_scene(flip_axes(pile, 0))
    (doubt,) = check_scene(shuffle_poses(pile, 0))
    assert "outlines that no body has" in doubt.text and not doubt.far_off


def test_check_scene_empty_data_raises(pile: Scene):
    images = pile.train.images[:1].repeat(len(pile.train), 1, 1, 1)
    images[1::2, ::5] ^= 1  # noise
    alike, one = Views.of(images, pile.train.cameras), pile.train[torch.tensor([3])]
    for views, words in ((one, "one photo to train on"), (alike, "all alike")):
        with pytest.raises(InputError, match=words):
            check_scene(replace(pile, train=views), corrected=True)


def test_check_scene_doubtful_scene_warns(pile: Scene):
    (doubt,) = check_scene(limited(3.6, None)(pile))
    assert "near=3.6 cuts" in doubt.text
    assert check_scene(limited(0.1, 40.0)(pile)) == [], "wider than the box: the box decides"

    (doubt,) = check_scene(
        replace(pile, train=change_poses(pile.train, lambda c2w: c2w[[0, 1, 2, 3, 4, 4, *range(6, 24)]]))
    )
    assert "1 of 24 training photos have the pose of another" in doubt.text

    images, poses = pile.val.images.clone(), pile.val.cameras.c2w.clone()
    images[1], poses[1] = pile.train.images[7], pile.train.cameras.c2w[7]
    leaked = replace(pile, val=Views.of(images, replace(pile.val.cameras, c2w=poses)))
    (doubt,) = check_scene(leaked)
    assert "1 of 4 held-out photos are trained on as well" in doubt.text


def test_check_visible_nothing_to_see_raises(pile: Scene):
    views = pile.train
    transparent = replace(views, pixels=torch.cat([views.pixels, 0 * views.pixels[:, :1]], dim=1))
    for hidden in (transparent, replace(views, known=torch.zeros(len(views.pixels), dtype=torch.bool))):
        with pytest.raises(InputError, match="leave out all of the training photos"):
            check_visible("photos", hidden)
