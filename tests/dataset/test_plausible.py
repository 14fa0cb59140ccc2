"""Data that cannot work is told before training; data that can is left alone."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds
from nerf_lightning.dataset import Scene, Views, load_npz, plausible, save_npz
from nerf_lightning.dataset.bricks.scene import bricks
from nerf_lightning.dataset.extent import border_colour
from nerf_lightning.dataset.plausible import check_scene, off_centre
from nerf_lightning.errors import InputError
from nerf_lightning.stability.damage import posed, shuffled, turned_to_opengl
from nerf_lightning.stability.toys import MARBLE, PILE, ROD, toy

WHITE = (1.0, 1.0, 1.0)
Change = Callable[[Scene], Scene]


def upside_down(c2w: torch.Tensor) -> torch.Tensor:
    c2w[:, :3, :2] *= -1
    return c2w


def limited(near: float | None, far: float | None) -> Change:
    return lambda scene: replace(scene, bounds=replace(scene.bounds, near=near, far=far))


@pytest.fixture(scope="module")
def pile() -> Scene:
    return toy(PILE, size=32)


@pytest.mark.parametrize(
    "scene",
    [
        lambda: toy(PILE, size=32),
        lambda: toy(PILE, None, size=32),
        lambda: toy(MARBLE, WHITE, size=32),
        lambda: toy(ROD, WHITE, size=32),
        lambda: toy(PILE, size=32, views=3),
        lambda: bricks(size=32, train_views=12, val_views=2),
    ],
    ids=["pile", "alpha", "white", "rod", "few", "bricks"],
)
def test_good_scenes_raise_no_doubt(scene: Callable[[], Scene]):
    assert check_scene(scene()) == []


HOPELESS: list[tuple[Change, str]] = [
    (lambda scene: turned_to_opengl(scene, 0), "backs to the point"),
    (lambda scene: replace(scene, background=WHITE), "while the background is said to be"),
    (limited(0.2, 0.6), "far=0.6 cuts"),
    (limited(20.0, None), "near=20 cuts"),
    (lambda scene: replace(scene, bounds=Bounds(0.2 * scene.bounds.aabb)), "beyond the box"),
]


@pytest.mark.parametrize(
    ("change", "words"),
    HOPELESS,
    ids=["opengl", "flag", "far", "near", "box"],
)
def test_hopeless_scenes_are_refused(change: Change, words: str, pile: Scene):
    with pytest.raises(InputError, match=words):
        check_scene(change(pile))


@pytest.mark.parametrize(
    "change",
    [lambda scene: replace(scene, train=posed(scene.train, upside_down)), lambda scene: shuffled(scene, 0)],
    ids=["upside down", "shuffled"],
)
def test_photos_that_do_not_fit_are_warned_of(change: Change, pile: Scene):
    (doubt,) = check_scene(change(pile))
    assert "outlines that no body has" in doubt.text


def test_outlines_that_hardly_fit_are_tried_where_poses_are_corrected(pile: Scene, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(plausible, "FITS", 0.97)
    inexact = shuffled(pile, 0)
    with pytest.raises(InputError, match="outlines that no body has"):
        check_scene(inexact)
    (doubt,) = check_scene(inexact, corrected=True)
    assert "outlines that no body has" in doubt.text and not doubt.far_off
    monkeypatch.setattr(plausible, "FITS_BADLY", 0.97)
    (doubt,) = check_scene(inexact, corrected=True)
    assert doubt.far_off
    for change, words in (HOPELESS[0], HOPELESS[-1]):
        with pytest.raises(InputError, match=words):
            check_scene(change(pile), corrected=True)


def test_doubtful_scenes_are_warned_of(pile: Scene):
    (doubt,) = check_scene(limited(3.6, None)(pile))
    assert "near=3.6 cuts" in doubt.text
    assert check_scene(limited(0.1, 40.0)(pile)) == [], "wider than the box: the box decides"

    (doubt,) = check_scene(replace(pile, train=posed(pile.train, lambda c2w: c2w[[0, 1, 2, 3, 4, 4, *range(6, 24)]])))
    assert "1 of 24 training photos have the pose of another" in doubt.text

    images, poses = pile.val.images.clone(), pile.val.cameras.c2w.clone()
    images[1], poses[1] = pile.train.images[7], pile.train.cameras.c2w[7]
    leaked = replace(pile, val=Views.of(images, replace(pile.val.cameras, c2w=poses)))
    (doubt,) = check_scene(leaked)
    assert "1 of 4 held-out photos are trained on as well" in doubt.text


def test_one_camera_that_looks_away(pile: Scene):
    def turned(c2w: torch.Tensor) -> torch.Tensor:
        c2w[0, :3, 1:3] *= -1
        return c2w

    doubts = check_scene(replace(pile, train=posed(pile.train, turned)))
    assert any("look away" in doubt.text for doubt in doubts)


def test_a_panorama_is_no_mistake(pile: Scene):
    """Cameras in one place that look outward have no common point to look at."""

    def outward(c2w: torch.Tensor) -> torch.Tensor:
        c2w[:, :3, 3] = 0.05 * c2w[:, :3, 2] + 0.3 * torch.randn(len(c2w), 3)
        return c2w

    bounds = Bounds(pile.bounds.aabb, unbounded=True)
    assert check_scene(replace(pile, train=posed(pile.train, outward), bounds=bounds)) == []


def test_the_border_tells_the_background(pile: Scene, tmp_path: Path):
    assert border_colour(pile.train) == (0.0, 0.0, 0.0)
    assert border_colour(toy(PILE, WHITE, size=32).train) == WHITE
    assert border_colour(toy(PILE, None, size=32).train) is None
    assert (
        border_colour(replace(pile.train, pixels=torch.randint(0, 255, pile.train.pixels.shape, dtype=torch.uint8)))
        is None
    )

    path = tmp_path / "white.npz"
    save_npz(toy(MARBLE, WHITE, size=32), path)
    arrays = dict(np.load(path))
    assert arrays.pop("background").tolist() == [1, 1, 1]
    np.savez(path, **arrays)
    assert load_npz(path).background == WHITE, "also where the file does not say"


def test_a_box_beside_what_cameras_look_at_is_told(pile: Scene):
    aside = replace(pile.bounds, aabb=pile.bounds.aabb + torch.tensor([3.0, 0, 0]))
    (text,) = (doubt.text for doubt in off_centre(replace(pile, bounds=aside)))
    assert "cameras stand around a place 3 beside the box's centre" in text
    tiny = replace(pile.bounds, aabb=0.1 * pile.bounds.aabb, unbounded=True)
    (text,) = (doubt.text for doubt in off_centre(replace(pile, bounds=tiny)))
    assert "times the box's half-size off its centre" in text
    assert not list(off_centre(replace(pile, bounds=replace(pile.bounds, unbounded=True))))
