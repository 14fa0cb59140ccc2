"""Matches between photos detect common mistakes with camera poses."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras import Bounds, Cameras, look_at
from nerf_lightning.dataset import Scene
from nerf_lightning.dataset.matching.epipolar import Matches, compute_inlier_ratio
from nerf_lightning.dataset.matching.features import Pair, detect_features, find_pairs
from nerf_lightning.dataset.matching.hypotheses import list_conventions, list_orders
from nerf_lightning.dataset.matching.pose_checks import compare_with_matches
from nerf_lightning.dataset.scene import BUILT_IN
from nerf_lightning.dataset.scene_checks import check_scene
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.corruptions import map_poses, scale_focal_length, shuffle_poses
from nerf_lightning.synthetic.objects import trace_rays
from nerf_lightning.synthetic.rooms import ROOMS, render_room

SIZE, FOCAL = 200, 220.0
GL = np.diag([1.0, -1.0, -1.0, 1.0])
UP = torch.tensor([0.0, 0.0, 1.0]).double()


def ring(count: int, outward: bool = False, distance: float = 2.5) -> np.ndarray:
    """Poses around the origin at changing heights and rolls."""
    angle = torch.arange(count).double() * 2 * np.pi / count
    eyes = distance * torch.stack([angle.cos(), angle.sin(), 0.4 + 0.2 * (3 * angle).sin()], dim=1)
    target = 4 * eyes if outward else 0.2 * torch.stack([angle.sin(), angle.cos(), angle.cos()], dim=1)
    return look_at(eyes, target, UP + 0.02).numpy()


def cameras_at(c2w: np.ndarray, focal: float = FOCAL, width: int = SIZE, height: int = SIZE) -> Cameras:
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Cameras.pinhole(K.repeat(len(c2w), 1, 1), torch.from_numpy(c2w).float(), width, height)


def matches_of(c2w: np.ndarray, spread: float) -> Matches:
    """Exact matches of neighbors: points around the origin, or surrounding the cameras."""
    points = torch.from_numpy(np.random.default_rng(0).normal(size=(4000, 3)) * spread).float()
    cameras = cameras_at(c2w)
    seen = [cameras.project(points, view) for view in range(len(c2w))]
    pairs = []
    for first in range(len(c2w)):
        second = (first + 1) % len(c2w)
        both = (seen[first][2] & seen[second][2]).numpy().nonzero()[0][:60]
        if len(both):
            pairs.append(Pair(first, second, np.stack([seen[i][0].numpy()[both] for i in (first, second)], axis=1)))
    return Matches.from_pairs(pairs, cameras)


def change_parts(
    rotation: Callable | None = None, center: Callable | None = None
) -> Callable[[np.ndarray], np.ndarray]:
    """Changes the rotations, and replaces the centers by a function of the poses."""

    def apply(c2w: np.ndarray) -> np.ndarray:
        moved = c2w.copy()
        moved[:, :3, :3] = c2w[:, :3, :3] if rotation is None else rotation(c2w[:, :3, :3])
        moved[:, :3, 3] = c2w[:, :3, 3] if center is None else center(c2w)
        return moved

    return apply


def roll_quaternions(rotation: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(np.roll(Rotation.from_matrix(rotation).as_quat(), 1, axis=1)).as_matrix()


MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
SIDEWAYS, OTHER_UP = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
MISTAKES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "camera axes of the other convention": lambda c2w: c2w @ GL,
    "world-to-camera matrices instead": np.linalg.inv,
    "world-to-camera matrices": lambda c2w: np.linalg.inv(c2w @ GL),
    "transposed rotations": change_parts(lambda R: R.transpose(0, 2, 1)),
    "world-to-camera translations": change_parts(center=lambda c2w: np.linalg.inv(c2w)[:, :3, 3]),
    "photos that are rotated by 90 or 180 degrees": change_parts(lambda R: R @ SIDEWAYS),
    "a mirrored world": lambda c2w: MIRROR @ c2w @ MIRROR,
    "quaternions in another order": change_parts(roll_quaternions),
    "centers and rotations in different world frames": change_parts(center=lambda c2w: c2w[:, :3, 3] @ OTHER_UP),
}


@pytest.mark.parametrize("words", MISTAKES)
def test_list_conventions_each_mistake_is_named(words: str):
    """Corrupts poses in their file's axes, with exact matches. Mirrors and photo rotations look alike in either convention."""
    change = MISTAKES[words]
    opengl = "mirrored" not in words and "90" not in words
    right = ring(24, outward=not opengl)
    matches = matches_of(right, 0.6 if opengl else 8.0)
    read = change(right @ GL) @ GL if opengl else change(right)
    assert compute_inlier_ratio(matches, right) == 1
    assert compute_inlier_ratio(matches, read) < 0.4

    assert max(compute_inlier_ratio(matches, hypothesis.c2w) for hypothesis in list_conventions(right)) < 0.98
    best = max(list_conventions(read), key=lambda hypothesis: compute_inlier_ratio(matches, hypothesis.c2w))
    assert compute_inlier_ratio(matches, best.c2w) == 1 and words in best.fault


def scene_of(c2w: np.ndarray, names: tuple[str, ...] = (), focal: float = 80.0, width: int = 96) -> Scene:
    """Photos of an unbounded room; every eighth is held out."""
    cameras = cameras_at(c2w, focal, width, 3 * width // 4)
    room = ROOMS["filling subject"]
    views = render_room(room, cameras)
    views = replace(views, names=names)
    held = torch.arange(len(c2w)) % 8 == 0
    bounds = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), unbounded=True)
    train, val = views[(~held).nonzero()[:, 0]], views[held.nonzero()[:, 0]]
    return Scene("room", BUILT_IN, train, val, cameras, bounds)


def diverging(count: int = 20) -> np.ndarray:
    """Forward-facing cameras whose axes diverge from the middle."""
    i = torch.arange(count)
    eyes = torch.stack([torch.full((count,), -2.4), 0.2 * (i % 5 - 2), 0.2 * (i // 5 - 1.5)], dim=1).double()
    ahead = torch.tensor([1.0, 0.0, 0.0]) + torch.tensor([0.0, 0.4, 0.4]) * eyes
    return look_at(eyes, eyes + ahead, UP).numpy()


@pytest.fixture(scope="module")
def forward() -> Scene:
    return scene_of(diverging(), tuple(f"{i}.png" for i in range(20)))


def test_check_cameras_diverging_axes_raise_no_issue(forward: Scene):
    """The axes converge behind the cameras, as flipped ones do."""
    assert compare_with_matches(forward) == ([], True)


def test_check_scene_one_wrong_pose_is_named(forward: Scene):
    def turn(c2w: torch.Tensor) -> torch.Tensor:
        c2w[3, :3, 1:3] *= -1
        return c2w

    (issue,) = check_scene(replace(forward, train=map_poses(forward.train, turn)))
    assert issue.text == "1 training photos whose poses do not fit the others: 4.png"


def change_poses_of(scene: Scene, change: Callable[[np.ndarray], np.ndarray]) -> Scene:
    """Changes the poses of both splits, ordered by name."""
    order = np.argsort([int(name.removesuffix(".png")) for name in scene.train.names + scene.val.names])
    every = torch.cat([scene.train.cameras.c2w, scene.val.cameras.c2w]).double().numpy()
    every[order] = change(every[order])
    moved = torch.from_numpy(every).float()
    train, val = moved[: len(scene.train)], moved[len(scene.train) :]
    return replace(scene, train=map_poses(scene.train, lambda _: train), val=map_poses(scene.val, lambda _: val))


ORDERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "each photo has that of the previous one": lambda c2w: np.roll(c2w, 1, axis=0),
    "each photo has that of the next one": lambda c2w: np.roll(c2w, -1, axis=0),
    "poses in the reverse order of the photos": lambda c2w: c2w[::-1].copy(),
    "names sorted as numbers": (lambda c2w: c2w[np.argsort(sorted(range(len(c2w)), key=lambda i: f"{i}.png"))]),
}


@pytest.mark.parametrize("words", ORDERS)
def test_list_orders_restores_the_order(words: str):
    """Independent of the split."""
    right = ring(24)
    order = np.argsort(np.arange(24) % 8 == 0, kind="stable")  # held-out photos come last
    names = [f"{i}.png" for i in order]
    hypotheses = list_orders(names, ORDERS[words](right)[order], np.arange(24))
    found = [hypothesis.fault for hypothesis in hypotheses if np.allclose(hypothesis.c2w, right[order])]
    assert len(found) == 1 and words in found[0]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda scene: change_poses_of(scene, lambda c2w: c2w @ GL), "camera axes of the other convention"),
        (lambda scene: shuffle_poses(scene, 0), "they belong to other photos"),
        (lambda scene: scale_focal_length(scene, 0, 4.0), "of 320 pixels, where about [6-9][0-9] would fit"),
        (
            lambda scene: replace(scene, val=map_poses(scene.val, lambda c2w: c2w.roll(1, 0))),
            "held-out photos whose",
        ),
    ],
    ids=["axes", "shuffled", "focal", "held out"],
)
def test_check_scene_wrong_cameras_raise(forward: Scene, spoil: Callable[[Scene], Scene], words: str):
    with pytest.raises(InputError, match=words):
        check_scene(spoil(forward))


def test_check_scene_shuffled_poses_with_refinement_warn(forward: Scene):
    (issue,) = check_scene(shuffle_poses(forward, 0), refines_poses=True)
    assert issue.is_refinable and issue.has_wrong_poses
    with pytest.raises(InputError, match="other convention"):
        check_scene(change_poses_of(forward, lambda c2w: c2w @ GL), refines_poses=True)


def test_find_pairs_matches_show_the_same_point(forward: Scene):
    """Points of hypothesis photo, at their true depth, project to their matches in the other."""
    off = []
    views, cameras = forward.train, forward.train.cameras
    for pair in find_pairs([detect_features(views, view) for view in range(len(views))], cameras)[:6]:
        column, row = torch.from_numpy(pair.keypoints[:, 0]).long().unbind(1)
        rays = cameras.generate_rays(torch.full_like(column, pair.first), row, column)
        points = rays.origins + rays.directions * trace_rays(ROOMS["filling subject"].primitives, rays)[1][:, None]
        places = cameras.project(points, pair.second)[0].numpy()
        off.append(np.linalg.norm(places - pair.keypoints[:, 1], axis=1))
    assert np.median(np.concatenate(off)) < 1.5
