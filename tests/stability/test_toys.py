"""Toy scenes against geometry done by hand, and the damage done to them."""

import math

import pytest
import torch

from nerf_lightning.cameras import Rays
from nerf_lightning.stability import damage
from nerf_lightning.stability.conditions import picture
from nerf_lightning.stability.rooms import ROOMS, indoors
from nerf_lightning.stability.toys import DISTANCE, MARBLE, PILE, Ball, Block, around, enclosing, in_sight, toy, trace

CUBE, BALL = Block((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), Ball((0.0, 0.0, 0.0), 0.5)


def ray(origin: list[float], direction: list[float]) -> Rays:
    return Rays(torch.tensor([origin]), torch.nn.functional.normalize(torch.tensor([direction]), dim=1))


@pytest.mark.parametrize(
    ("body", "start", "way", "distance", "normal"),
    [
        (BALL, [0.0, 0.0, 3.0], [0.0, 0.0, -1.0], 2.5, [0.0, 0.0, 1.0]),
        (Ball((1.0, 0.0, 0.0), 0.5), [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 0.5, [-1.0, 0.0, 0.0]),
        (BALL, [0.0, 0.0, 3.0], [0.0, 1.0, 0.0], math.inf, None),
        (BALL, [0.0, 0.0, 3.0], [0.0, 0.0, 1.0], math.inf, None),
        (CUBE, [3.0, 0.2, 0.1], [-1.0, 0.001, 0.001], 2.0, [1.0, 0.0, 0.0]),
        (CUBE, [3.0, 2.0, 0.0], [-1.0, 0.001, 0.001], math.inf, None),
    ],
)
def test_where_rays_meet_bodies(body, start, way, distance, normal):
    t, found = body.meet(ray(start, way))
    assert float(t) == pytest.approx(distance, rel=1e-5)
    if normal is not None:
        assert found[0].tolist() == pytest.approx(normal, abs=1e-6)


def test_the_nearer_body_is_seen():
    red, behind = Ball((0.0, 0.0, 1.0), 0.3), Ball((0.0, 0.0, -1.0), 0.3)
    colour, cover = trace([behind, red], ray([0.0, 0.0, 4.0], [0.0, 0.0, -1.0]))
    alone, _ = trace([red], ray([0.0, 0.0, 4.0], [0.0, 0.0, -1.0]))
    assert torch.equal(colour, alone) and cover.tolist() == [1.0]


def test_what_is_out_of_sight_changes_nothing():
    bodies: list = [Ball((x, y, 0.0), 0.1) for x in (-0.8, 0.0, 0.8) for y in (-0.8, 0.0, 0.8)] + PILE
    rays = around(3, 24).view_rays(1)
    few = 0
    for start in range(0, len(rays), 24):
        some = rays[start : start + 12]
        near = in_sight(bodies, some)
        few += len(near) < len(bodies)
        whole, cover = trace(bodies, some)
        assert bool(cover.any()) <= bool(near)
        if near:
            colour, alone = trace(near, some)
            assert torch.equal(colour, whole) and torch.equal(alone, cover)
    assert few > 20


def test_cameras_stand_apart_and_look_at_the_middle():
    train, val = around(24, 32), around(4, 32, phase=0.7)
    centres = torch.cat([train.centres, val.centres])
    assert torch.cdist(centres, centres).fill_diagonal_(9).min() > 0.2
    assert torch.allclose(centres.norm(dim=1), torch.tensor(DISTANCE))
    assert torch.allclose(train.c2w[:, :3, 2], -train.centres / DISTANCE, atol=1e-5)


def test_a_small_object_covers_what_it_should():
    """A ball of radius 0.3 at distance 4 in a field of 0.7: about 3 % of the picture."""
    scene = toy(MARBLE, (1.0, 1.0, 1.0))
    shown = (scene.train.images != 255).any(-1).float().mean()
    half_picture = 4 * math.tan(0.35)
    assert float(shown) == pytest.approx(math.pi * 0.3**2 / (2 * half_picture) ** 2, rel=0.2)
    assert toy(MARBLE, None).train.images.shape[-1] == 4


def test_bounds_hold_all_bodies():
    aabb = enclosing(PILE).aabb
    for body in PILE:
        assert (body.box[0] > aabb[0]).all() and (body.box[1] < aabb[1]).all()


def test_the_same_every_time():
    assert toy(PILE, size=16).sha256() == toy(PILE, size=16).sha256()
    for change in (damage.shuffled, lambda s, seed: damage.with_noise(s, seed, 0.1)):
        first, again, other = (change(toy(PILE, size=16), seed) for seed in (1, 1, 2))
        assert first.sha256() == again.sha256()
        assert torch.equal(first.train.cameras.c2w, again.train.cameras.c2w)
        assert first.sha256() != other.sha256() or not torch.equal(first.train.cameras.c2w, other.train.cameras.c2w)


def test_damage():
    scene = toy(PILE, size=16)
    flipped = damage.turned_to_opengl(scene, 0)
    assert torch.allclose(flipped.train.cameras.c2w[:, :3, 2], -scene.train.cameras.c2w[:, :3, 2])
    assert len(damage.with_views(scene, 0, 3).train) == 3
    big = damage.scaled(scene, 0, 10.0)
    assert torch.allclose(big.train.cameras.centres, 10 * scene.train.cameras.centres)
    assert torch.allclose(big.bounds.aabb, 10 * scene.bounds.aabb)
    assert torch.equal(scene.train.cameras.c2w, toy(PILE, size=16).train.cameras.c2w), "the scene itself is untouched"
    turned = damage.with_pose_noise(scene, 0, 5.0).train.cameras.c2w[:, :3, :3]
    trace_ = (turned.mT @ scene.train.cameras.c2w[:, :3, :3]).diagonal(dim1=1, dim2=2).sum(1)
    angles = ((trace_ - 1) / 2).clamp(-1, 1).acos() * 180 / math.pi
    assert float(angles.square().mean().sqrt()) == pytest.approx(5.0, rel=0.4)
    moved = damage.with_pose_noise(scene, 0, 0.0, 0.05).train.cameras.centres - scene.train.cameras.centres
    assert float(moved.square().sum(1).mean().sqrt()) == pytest.approx(0.05 * DISTANCE, rel=0.4)
    wrong = damage.with_wrong_poses(scene, 0, 3).train.cameras.c2w != scene.train.cameras.c2w
    assert int(wrong.flatten(1).any(1).sum()) == 3
    tinted = damage.with_exposure_drift(toy(PILE, None, size=16), 0, 0.0, 0.1).train.images.float()
    whole = toy(PILE, None, size=16)
    plain, held_out = whole.train.images.float(), whole.val.images.float()
    shares = tinted[..., :3].sum((1, 2)) / plain[..., :3].sum((1, 2))
    assert float((shares[:, 0] / shares[:, 1] - 1).abs().max()) > 0.02 and torch.equal(tinted[..., 3], plain[..., 3])
    dark = damage.with_dark_corners(whole, 0, 0.5).val.images.float()
    side = (torch.arange(16) + 0.5) / 8 - 1
    shade = 1 - 0.25 * (side[:, None].square() + side.square())
    assert held_out.amax() > 100 and float(shade.min()) < 0.6
    torch.testing.assert_close(dark[..., :3], held_out[..., :3] * shade[..., None], atol=0.51, rtol=0)
    for part in (damage.with_focal_length(scene, 0, 1.1).train, damage.with_focal_length(scene, 0, 1.1).val):
        torch.testing.assert_close(part.cameras.K[:, 0, 0], 1.1 * scene.train.cameras.K[:1, 0, 0].expand(len(part)))
    drifted = damage.with_exposure_drift(scene, 0, 0.3)
    sums = [one.train.images.float().sum((1, 2, 3)) for one in (drifted, scene)]
    gains = sums[0] / sums[1]
    assert 0.69 < gains.min() < 0.9 < 1.1 < gains.max() < 1.31
    assert damage.with_noise(scene, 0, 0.1).train.images.float().std() > scene.train.images.float().std()


def test_the_picture_holds_all_frequencies_down_to_six_pixels_of_training():
    image = picture(96, 16).image
    assert image.shape == (32, 192, 3)
    spectrum = torch.fft.rfft(image[0, :, 0].float() - 127.5).abs()
    assert (spectrum[1:16] > 100).float().mean() > 0.8
    assert spectrum[20:].max() < 0.2 * spectrum.max(), "nothing that the smaller picture cannot show"


def test_a_room_is_photographed_from_a_ring_around_its_subject():
    room = ROOMS["small subject"]
    scene = indoors(room, 0, size=16, views=8, held_out=2)
    eyes = torch.cat([scene.train.cameras.c2w[:, :3, 3], scene.val.cameras.c2w[:, :3, 3]])
    assert ((eyes.norm(dim=1) - 1).abs() < 0.4).all()
    assert (eyes[:, 2] > 0).all()
    assert scene.bounds.unbounded
    _, distance, body = room.see(scene.train.cameras.view_rays(0))
    assert distance.isfinite().all()
    assert 0 < float((body < room.subject).float().mean()) < 0.1
    assert not torch.equal(scene.train.cameras.c2w, indoors(room, 1, size=16, views=8).train.cameras.c2w)
