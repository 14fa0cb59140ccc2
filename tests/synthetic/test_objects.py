"""Synthetic scenes against geometry done by hand, and their corruptions."""

import math

import pytest
import torch

from nerf_lightning.cameras import Rays
from nerf_lightning.synthetic import corruptions
from nerf_lightning.synthetic.objects import CAMERA_DISTANCE, MARBLE, PILE, Box, Sphere, make_object_scene, trace_rays
from nerf_lightning.synthetic.rooms import ROOMS, make_room_scene

CUBE, BALL = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), Sphere((0.0, 0.0, 0.0), 0.5)


def ray(origin: list[float], direction: list[float]) -> Rays:
    return Rays(torch.tensor([origin]), torch.nn.functional.normalize(torch.tensor([direction]), dim=1))


@pytest.mark.parametrize(
    ("body", "start", "direction", "distance", "normal"),
    [
        (BALL, [0.0, 0.0, 3.0], [0.0, 0.0, -1.0], 2.5, [0.0, 0.0, 1.0]),
        (BALL, [0.0, 0.0, 3.0], [0.0, 0.0, 1.0], math.inf, None),
        (CUBE, [3.0, 0.2, 0.1], [-1.0, 0.001, 0.001], 2.0, [1.0, 0.0, 0.0]),
        (CUBE, [3.0, 2.0, 0.0], [-1.0, 0.001, 0.001], math.inf, None),
    ],
)
def test_intersect_gives_distance_and_normal(body, start, direction, distance, normal):
    t, found = body.intersect(ray(start, direction))
    assert float(t) == pytest.approx(distance, rel=1e-5)
    if normal is not None:
        assert found[0].tolist() == pytest.approx(normal, abs=1e-6)


def test_trace_rays_of_two_primitives_hits_nearer():
    near, far = Sphere((0.0, 0.0, 1.0), 0.3), Sphere((0.0, 0.0, -1.0), 0.3)
    down = ray([0.0, 0.0, 4.0], [0.0, 0.0, -1.0])
    color, distance, index = trace_rays([far, near], down)
    assert torch.equal(color, trace_rays([near], down)[0])
    assert distance.tolist() == pytest.approx([2.7]) and index.tolist() == [1]
    color, distance, _ = trace_rays([far, near], ray([0.0, 0.0, 4.0], [0.0, 0.0, 1.0]))
    assert color.tolist() == [[0, 0, 0]] and distance.tolist() == [math.inf]


def test_make_object_scene_shows_sphere_at_its_size():
    """A sphere of radius 0.3 at distance 4, field of view 0.7 rad: about 3 % of the photo."""
    scene = make_object_scene(MARBLE, (1.0, 1.0, 1.0))
    shown = (scene.train.images != 255).any(-1).float().mean()
    assert float(shown) == pytest.approx(math.pi * 0.3**2 / (8 * math.tan(0.35)) ** 2, rel=0.2)
    assert make_object_scene(MARBLE, None, size=8).train.images.shape[-1] == 4


def test_make_room_scene_is_photographed_from_ring_around_subject():
    room = ROOMS["small subject"]
    scene = make_room_scene(room, 0, size=16, views=8, held_out=2)
    eyes = torch.cat([scene.train.cameras.centers, scene.val.cameras.centers])
    assert ((eyes.norm(dim=1) - 1).abs() < 0.4).all() and (eyes[:, 2] > 0).all() and scene.bounds.unbounded
    _, distance, body = trace_rays(room.primitives, scene.train.cameras.generate_view_rays(0))
    assert distance.isfinite().all() and 0 < float((body < room.num_subject_primitives).float().mean()) < 0.1
    other = make_room_scene(room, 1, size=16, views=8, held_out=2)
    assert not torch.equal(scene.train.cameras.c2w, other.train.cameras.c2w)


def test_corruptions_of_poses_and_bounds_have_their_size():
    scene = make_object_scene(PILE, size=8)
    original = scene.train.cameras.c2w.clone()
    flipped = corruptions.flip_axes(scene, 0).train.cameras.c2w
    assert torch.equal(flipped[:, :3, 1:3], -original[:, :3, 1:3])
    assert torch.equal(flipped[:, :3, 3], original[:, :3, 3])
    big = corruptions.scale_world(scene, 0, 10.0)
    assert torch.equal(big.train.cameras.centers, 10 * original[:, :3, 3])
    turned = corruptions.add_pose_noise(scene, 0, 5.0).train.cameras.c2w[:, :3, :3]
    traces = (turned.mT @ original[:, :3, :3]).diagonal(dim1=1, dim2=2).sum(1)
    degrees = ((traces - 1) / 2).clamp(-1, 1).acos() * 180 / math.pi
    assert float(degrees.square().mean().sqrt()) == pytest.approx(5.0, rel=0.4)
    moved = corruptions.add_pose_noise(scene, 0, 0.0, 0.05).train.cameras.centers - original[:, :3, 3]
    assert float(moved.square().sum(1).mean().sqrt()) == pytest.approx(0.05 * CAMERA_DISTANCE, rel=0.4)
    assert int((corruptions.swap_poses(scene, 0, 3).train.cameras.c2w != original).flatten(1).any(1).sum()) == 3
    longer = corruptions.scale_focal_length(scene, 0, 1.1)
    for part in (longer.train, longer.val):
        assert torch.allclose(part.cameras.K[:, 0, 0], 1.1 * scene.train.cameras.K[0, 0, 0])
    assert torch.equal(scene.train.cameras.c2w, original), "the scene itself is untouched"


def test_corruptions_of_colors_have_their_size():
    scene = make_object_scene(PILE, None, size=16)
    plain, held_out = scene.train.images.float(), scene.val.images.float()
    gains = corruptions.vary_exposure(scene, 0, 0.3).train.images[..., :3].float().sum((1, 2, 3))
    gains = gains / plain[..., :3].sum((1, 2, 3))
    assert 0.69 < gains.min() < 0.9 < 1.1 < gains.max() < 1.31
    tinted = corruptions.vary_exposure(scene, 0, 0.0, 0.1).train.images.float()
    shares = tinted[..., :3].sum((1, 2)) / plain[..., :3].sum((1, 2))
    assert float((shares[:, 0] / shares[:, 1] - 1).abs().max()) > 0.02 and torch.equal(tinted[..., 3], plain[..., 3])
    dark = corruptions.add_vignetting(scene, 0, 0.5).val.images.float()
    side = (torch.arange(16) + 0.5) / 8 - 1
    shade = 1 - 0.25 * (side[:, None].square() + side.square())
    torch.testing.assert_close(dark[..., :3], held_out[..., :3] * shade[..., None], atol=0.51, rtol=0)
