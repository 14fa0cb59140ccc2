"""What the page about a scene draws, against the scene's own geometry."""

import math

import numpy as np
import pytest
import torch

from nerf_lightning.dataset import Scene
from nerf_lightning.view.drawing import frusta, overview, path_segments, through


def test_frusta_are_where_the_cameras_are(scene: Scene):
    drawn = list(frusta(scene.train, 8))
    assert [f.name for f in drawn] == ["photo 0", "photo 1", "photo 2", "photo 3"]
    for frustum, c2w, K in zip(drawn, scene.train.cameras.c2w, scene.train.cameras.K, strict=True):
        assert np.array_equal(frustum.c2w, c2w.numpy())
        assert frustum.fov == pytest.approx(2 * math.atan(8 / float(K[1, 1])))
        assert frustum.aspect == pytest.approx(1)
        assert frustum.photo.shape == (8, 8, 4)


def test_path_segments_close_a_ring_not_a_sweep(scene: Scene):
    ring = path_segments(scene.orbit)
    assert len(ring) == 6
    assert np.array_equal(ring[-1, 1], ring[0, 0])
    assert len(path_segments(scene.orbit[:3])) == 2
    assert path_segments(scene.orbit[:1]).shape == (0, 2, 3)


def test_overview_sees_all_cameras_and_the_box(scene: Scene):
    view = overview(scene)
    ahead = view.look_at - view.position
    ahead /= np.linalg.norm(ahead)
    np.testing.assert_allclose(view.up, [0, 0, 1], atol=1e-5)
    for point in torch.cat([scene.train.cameras.centres, scene.val.cameras.centres, scene.bounds.aabb]).numpy():
        toward = point - view.position
        assert toward @ ahead / np.linalg.norm(toward) >= math.cos(view.fov / 2) - 1e-6


def test_through_a_frustum_looks_as_its_camera_did(scene: Scene):
    frustum = next(frusta(scene.train, 8))
    view = through(frustum, 4.0, np.array([0.0, 0.0, 1.0], np.float32))
    right, down, ahead, centre = scene.train.cameras.c2w[0, :3].T.numpy()
    np.testing.assert_allclose(view.position, centre)
    np.testing.assert_allclose(view.look_at, centre + 4 * ahead, rtol=1e-6)
    assert abs(view.up @ right) < 1e-6  # no roll
    assert view.up @ down < 0
    np.testing.assert_allclose(through(frustum, 4.0, down).up, -down)  # taken upside down
