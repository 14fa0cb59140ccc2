"""The built-in scene against closed forms and ray-by-ray tracing in double precision."""

import math

import numpy as np
import pytest
import torch

from benchmarks.synthetic.tabletop import find_nearest, shade_points
from nerf_lightning.cameras import Bounds
from nerf_lightning.kernels.cpu.solids import LIGHT_POSITION, is_unshadowed
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.synthetic.solids import Solids, load_bulldozer
from nerf_lightning.synthetic.tracer import rasterize, render_shadow_map

TILTED_AXES = [[1, 0, 0], [0, math.sqrt(0.5), -math.sqrt(0.5)], [0, math.sqrt(0.5), math.sqrt(0.5)]]


@pytest.fixture(scope="module")
def scene():
    return bricks(size=40, train_views=4, val_views=2, orbit_views=3)


def make_solid(cylinder: bool, half: tuple[float, float, float], axes: object = np.eye(3)) -> Solids:
    plain = {name: np.zeros(1) for name in ("period", "gloss")}
    plain |= {"color": np.ones((1, 3)), "accent": np.ones((1, 3)), "pattern": np.zeros(1, int)}
    return Solids(np.array([cylinder]), np.zeros((1, 3)), np.array([half], float), np.array([axes], float), **plain)


def trace_exactly(rays):
    """The bulldozer in double precision: origins, directions, the solid each ray hits and the distance to it."""
    origins, directions = rays.origins.double().numpy(), rays.directions.double().numpy()
    return origins, directions, *find_nearest(load_bulldozer(), origins, directions)


BOX, CYLINDER = make_solid(False, (1, 2, 3)), make_solid(True, (0.5, 0.5, 1))
BAR = make_solid(False, (0.2, 0.1, math.sqrt(2)), TILTED_AXES)


@pytest.mark.parametrize(
    ("solids", "origin", "direction", "distance"),
    [
        (BOX, (5, 0.5, 0), (-1, 0, 0), 4),
        (BOX, (0, -2, 5), (0, math.sqrt(0.5), -math.sqrt(0.5)), 2 * math.sqrt(2)),
        (BOX, (0, 0, 0), (1, 0, 0), math.inf),  # starts inside
        # Across the bar's 45 degree slope its thickness of 0.2 spans 0.2 * sqrt(2) of a vertical ray, half of it above.
        (BAR, (0.1, 0.3, 5), (0, 0, -1), 5 - 0.3 - 0.1 * math.sqrt(2)),
        (CYLINDER, (5, 0.3, 0), (-1, 0, 0), 4.6),  # 0.3 off the axis the half-chord is 0.4
        (CYLINDER, (0.4, 0.4, 5), (0, 0, -1), math.inf),  # within the box around it, past the cap's rim
    ],
)
def test_find_nearest_gives_distance(solids, origin, direction, distance):
    assert find_nearest(solids, np.array([origin]), np.array([direction]))[1][0] == pytest.approx(distance, rel=1e-6)


def test_solids_aabb_turned_cylinder_is_exact():
    reach = math.sqrt(0.5) * (1 + 0.5)
    aabb = make_solid(True, (0.5, 0.5, 1), TILTED_AXES).aabb
    np.testing.assert_allclose(aabb, [[-0.5, -reach, -reach], [0.5, reach, reach]])


def test_bricks_images_have_fixed_hash(scene):
    assert scene.sha256().startswith("7869af40dd6c")


def test_bricks_traced_images_are_cached_and_damaged_ones_traced_again(tmp_path, monkeypatch):
    monkeypatch.setenv("NERF_LIGHTNING_CACHE", str(tmp_path))
    traced = bricks(8, 2, 1, 1).sha256()
    (file,) = tmp_path.glob("*train.npz")
    file.write_bytes(file.read_bytes()[:100])
    assert bricks(8, 2, 1, 1).sha256() == traced
    monkeypatch.setattr("nerf_lightning.synthetic.bricks.render_view", lambda *_: pytest.fail("traced again"))
    assert bricks(8, 2, 1, 1).sha256() == traced


def test_bricks_cameras_match_the_paper(scene):
    aabb = torch.from_numpy(load_bulldozer().aabb).float()
    torch.testing.assert_close(scene.bounds.half_size, 1.02 * Bounds(aabb).half_size)
    for cameras in (scene.train.cameras, scene.val.cameras, scene.orbit):
        torch.testing.assert_close(cameras.centers.norm(dim=-1), torch.full((len(cameras),), 4.0311))
        looks = cameras.c2w[:, :3, 2]
        torch.testing.assert_close(looks, -cameras.centers / 4.0311, atol=1e-5, rtol=0)
        assert (cameras.centers[:, 2] > 0).all()
        assert (cameras.c2w[:, 2, 1] < 0).all()  # the image's down goes down
        torch.testing.assert_close(cameras.c2w[:, 2, 0], torch.zeros(len(cameras)), atol=1e-6, rtol=0)  # no roll
        # 800 px at 1111.111 px focal length are the paper's; 40 px are a twentieth.
        torch.testing.assert_close(cameras.K[:, 0, 0], torch.full((len(cameras),), 1111.111 / 20))
        assert (cameras.K[:, :2, 2] == 20).all()


def test_bricks_held_out_views_differ_from_training_views():
    scene = bricks(size=1)
    train, val = (views.cameras.centers / 4.0311 for views in (scene.train, scene.val))
    assert (len(train), len(val), len(scene.orbit)) == (100, 10, 60)
    angles = torch.rad2deg((val @ train.T).clamp(-1, 1).arccos().amin(1))
    # Spread: whatever the direction, a training view is near, and all heights occur.
    assert angles.min() > 2 and angles.max() < 15
    for heights in (train[:, 2], val[:, 2]):
        assert heights.min() < 0.15 and heights.max() > 0.85


def test_render_view_agrees_with_rays_traced_one_by_one(scene):
    cameras = scene.train.cameras
    solid, depth = rasterize(load_bulldozer(), cameras, 2)
    rays = cameras.generate_view_rays(2)
    _, _, expected, distance = trace_exactly(rays)
    along = distance * (rays.directions @ cameras.c2w[2, :3, 2]).double().numpy()
    same = solid.reshape(-1) == expected
    assert same.mean() > 0.998
    hit = same & (expected >= 0)
    np.testing.assert_allclose(depth.reshape(-1)[hit], along[hit], atol=1e-4)
    # The image is the mean of nine rays a pixel, over those that hit.
    origins, directions, solid, t = trace_exactly(cameras.resize((120, 120)).generate_view_rays(2))
    seen = np.flatnonzero(solid >= 0)
    rgba = np.zeros((len(t), 4))
    points = origins[seen] + t[seen, None] * directions[seen]
    rgba[seen] = np.pad(shade_points(solid[seen], points, directions[seen]), ((0, 0), (0, 1)), constant_values=1)
    total = rgba.reshape(40, 3, 40, 3, 4).sum((1, 3))
    expected = np.concatenate([total[..., :3] / total[..., 3:].clip(1), total[..., 3:] / 9], axis=-1)
    assert (np.abs(scene.train.images[2].numpy() / 255 - expected).max(-1) < 0.01).mean() > 0.98


def test_render_shadow_map_agrees_with_rays_to_the_light(scene):
    origins, directions, solid, t = trace_exactly(scene.train.cameras.generate_view_rays(3))
    hit = np.flatnonzero(solid >= 0)[::3]
    points = origins[hit] + t[hit, None] * directions[hit]
    light = np.array(LIGHT_POSITION, float)
    first, way = find_nearest(load_bulldozer(), np.broadcast_to(light, points.shape), points - light)
    expected = (first == solid[hit]) | (way > 1 - 1e-3)
    assert 0.2 < expected.mean() < 0.95
    found = [is_unshadowed.py_func(render_shadow_map(), k, point) for k, point in zip(solid[hit], points, strict=True)]
    assert (np.array(found) == expected).mean() > 0.96
