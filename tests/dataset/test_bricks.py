"""The built-in scene against closed forms, brute force and its own geometry."""

import math

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds
from nerf_lightning.dataset.bricks import scene as module
from nerf_lightning.dataset.bricks.model import bulldozer
from nerf_lightning.dataset.bricks.scene import bricks
from nerf_lightning.dataset.bricks.shading import LIGHT
from nerf_lightning.dataset.bricks.solids import Builder, Material
from nerf_lightning.dataset.bricks.trace import nearest, shadow, trace, visible

SMALL = {"size": 40, "train_views": 4, "val_views": 2, "orbit_views": 3}
MATERIAL = Material((1.0, 1.0, 1.0))


@pytest.fixture(scope="module")
def scene():
    return bricks(**SMALL, cache="")


def enter(builder, origin, direction):
    return nearest(builder.build(), np.array([origin], float), np.array([direction], float))[1][0]


def trace_exactly(rays):
    """The bulldozer in double precision: origins, directions, the solid each ray hits and the distance to it."""
    origins, directions = rays.origins.double().numpy(), rays.directions.double().numpy()
    return origins, directions, *nearest(bulldozer(), origins, directions)


def test_nearest_box_distances():
    b = Builder()
    b.box((-1, -2, -3), (1, 2, 3), MATERIAL)
    assert enter(b, (5, 0.5, 0), (-1, 0, 0)) == pytest.approx(4)
    assert enter(b, (0, 0, 5), (0, 0, -1)) == pytest.approx(2)
    # 45 degrees down onto the upper face: sqrt(2) longer than the drop of 2.
    assert enter(b, (0, -2, 5), (0, math.sqrt(0.5), -math.sqrt(0.5))) == pytest.approx(2 * math.sqrt(2))
    assert enter(b, (5, 2.01, 0), (-1, 0, 0)) == np.inf
    assert enter(b, (5, 0, 0), (1, 0, 0)) == np.inf  # behind
    assert enter(b, (0, 0, 0), (1, 0, 0)) == np.inf  # starts inside


def test_nearest_bar_distances():
    b = Builder()
    b.bar((0, -1, -1), (0, 1, 1), width=0.4, thickness=0.2, material=MATERIAL)
    # Across the bar's 45 degree slope its thickness of 0.2 spans 0.2 * sqrt(2) of a vertical ray, half of it above.
    assert enter(b, (0.1, 0.3, 5), (0, 0, -1)) == pytest.approx(5 - 0.3 - 0.1 * math.sqrt(2))
    assert enter(b, (5, 0.3, 0.3), (-1, 0, 0)) == pytest.approx(4.8)
    assert enter(b, (5, 0.3, -0.3), (-1, 0, 0)) == np.inf


def test_nearest_cylinder_distances():
    b = Builder()
    b.cylinder((0, 0, -1), (0, 0, 1), 0.5, MATERIAL)
    # 0.3 off the axis the half-chord is 0.4.
    assert enter(b, (5, 0.3, 0), (-1, 0, 0)) == pytest.approx(4.6)
    assert enter(b, (0.3, 0.3, 5), (0, 0, -1)) == pytest.approx(4)
    assert enter(b, (0.4, 0.4, 5), (0, 0, -1)) == np.inf  # within the box around it, past the cap's rim
    assert enter(b, (5, 0.51, 0), (-1, 0, 0)) == np.inf
    assert enter(b, (5, 0, 1.01), (-1, 0, 0)) == np.inf


def test_solids_aabb_turned_cylinder_is_exact():
    b = Builder()
    b.cylinder((0, -1, -1), (0, 1, 1), 0.5, MATERIAL)
    reach = 1 + 0.5 * math.sqrt(0.5)
    np.testing.assert_allclose(b.build().aabb, [[-0.5, -reach, -reach], [0.5, reach, reach]])


def test_bricks_images_have_smooth_alpha(scene):
    assert scene.train.images.shape == (4, 40, 40, 4)
    assert scene.val.images.shape == (2, 40, 40, 4)
    assert len(scene.orbit) == 3
    alpha = scene.train.images[..., 3]
    border = torch.cat([alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]])
    assert (border == 0).all()
    assert (alpha == 255).flatten(1).any(1).all()
    # Edges are smooth: some alphas lie between, and none but multiples of a sample's share.
    assert set(alpha.unique().tolist()) == {round(255 * k / 9) for k in range(10)}
    assert (scene.train.images[..., :3][alpha == 0] == 0).all()
    # Straight alpha: edge pixels are as bright as the model, not darkened by the background.
    rgb = scene.train.images[..., :3].float().mean(-1)
    assert rgb[(alpha > 0) & (alpha < 100)].mean() > 0.6 * rgb[alpha == 255].mean()


def test_bricks_cameras_match_the_paper(scene):
    for cameras in (scene.train.cameras, scene.val.cameras, scene.orbit):
        torch.testing.assert_close(cameras.centres.norm(dim=-1), torch.full((len(cameras),), 4.0311))
        looks = cameras.c2w[:, :3, 2]
        torch.testing.assert_close(looks, -cameras.centres / 4.0311, atol=1e-5, rtol=0)
        assert (cameras.centres[:, 2] > 0).all()
        assert (cameras.c2w[:, 2, 1] < 0).all()  # the image's down goes down
        torch.testing.assert_close(cameras.c2w[:, 2, 0], torch.zeros(len(cameras)), atol=1e-6, rtol=0)  # no roll
        # 800 px at 1111.111 px focal length are the paper's; 40 px are a twentieth.
        torch.testing.assert_close(cameras.K[:, 0, 0], torch.full((len(cameras),), 1111.111 / 20))
        assert (cameras.K[:, :2, 2] == 20).all()


def test_bricks_held_out_views_are_apart(monkeypatch):
    monkeypatch.setattr(module, "picture", lambda cameras, view: np.zeros((1, 1, 4), np.uint8))
    scene = bricks(size=1, cache="")
    train, val = (views.cameras.centres / 4.0311 for views in (scene.train, scene.val))
    assert (len(train), len(val), len(scene.orbit)) == (100, 10, 60)
    angles = torch.rad2deg((val @ train.T).clamp(-1, 1).arccos().amin(1))
    assert angles.min() > 2
    # Spread: whatever the direction, a training view is near, and all heights occur.
    assert angles.max() < 15
    for heights in (train[:, 2], val[:, 2]):
        assert heights.min() < 0.15 and heights.max() > 0.85


def test_bricks_bounds_hold_the_model(scene):
    aabb = torch.from_numpy(bulldozer().aabb).float()
    torch.testing.assert_close(scene.bounds.aabb.mean(0), aabb.mean(0))
    torch.testing.assert_close(scene.bounds.half_size, 1.02 * Bounds(aabb).half_size)
    rays = scene.train.cameras.view_rays(0)
    _, hit, t = trace(rays)
    points = (rays.origins + t[:, None] * rays.directions)[hit]
    assert (points >= aabb[0] - 1e-4).all() and (points <= aabb[1] + 1e-4).all()


def test_picture_agrees_with_trace(scene):
    """The rasterising tracer in single precision against ray-by-ray tracing in double."""
    cameras = scene.train.cameras
    solid, depth = visible(bulldozer(), cameras, 2)
    rays = cameras.view_rays(2)
    _, _, expected, distance = trace_exactly(rays)
    along = distance * (rays.directions @ cameras.c2w[2, :3, 2]).double().numpy()
    same = solid.reshape(-1) == expected
    assert same.mean() > 0.998
    hit = same & (expected >= 0)
    np.testing.assert_allclose(depth.reshape(-1)[hit], along[hit], atol=1e-4)
    # The picture is the mean of nine rays a pixel, over those that hit.
    rgb, hit, _ = trace(cameras.resized((120, 120)).view_rays(2))
    rgb, hit = (x.reshape(40, 3, 40, 3, -1).float().transpose(1, 2).flatten(2, 3).sum(2) for x in (rgb, hit))
    expected = torch.cat([rgb / hit.clamp_min(1), hit / 9], dim=-1)
    error = (scene.train.images[2] / 255 - expected).abs().amax(-1)
    assert (error < 0.01).float().mean() > 0.98


def test_shadow_agrees_with_rays_to_the_light(scene):
    origins, directions, solid, t = trace_exactly(scene.train.cameras.view_rays(3))
    hit = solid >= 0
    points = origins[hit] + t[hit, None] * directions[hit]
    to_light = LIGHT - points
    first, way = nearest(bulldozer(), np.broadcast_to(LIGHT, points.shape), -to_light)
    expected = (first == solid[hit]) | (way > 1 - 1e-3)
    assert 0.2 < expected.mean() < 0.95
    assert (shadow()(solid[hit], points) == expected).mean() > 0.96
