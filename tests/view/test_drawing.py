"""What the page about a scene draws, against the scene's own geometry."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras, Rays, transform
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.view.drawing import (
    frusta,
    overview,
    path_segments,
    random_rays,
    ray_figure,
    through,
)


def off_centre(views: Views) -> Views:
    """The same photos through a lens whose axis meets them 2 pixels right of and 4 above the middle; no square pixels."""
    K = torch.tensor([[20.0, 0.0, 10.0], [0.0, 25.0, 4.0], [0.0, 0.0, 1.0]])
    return replace(views, cameras=replace(views.cameras, K=K.expand_as(views.cameras.K)))


def test_frusta_are_where_the_cameras_are(scene: Scene):
    drawn = list(frusta(scene.train, 8))
    assert [f.name for f in drawn] == ["photo 0", "photo 1", "photo 2", "photo 3"]
    for frustum, c2w, K in zip(drawn, scene.train.cameras.c2w, scene.train.cameras.K, strict=True):
        assert np.array_equal(frustum.c2w, c2w.numpy())
        assert frustum.fov == pytest.approx(2 * math.atan(8 / float(K[1, 1])))
        assert frustum.aspect == pytest.approx(1)
        assert frustum.photo.shape == (8, 8, 4)


def pixel_of(cameras: Cameras, view: int, rays: Rays) -> torch.Tensor:
    """Where a view sees points a unit down its rays; continuous pixels [R, 2]."""
    points = rays.origins + rays.directions
    local = transform(torch.linalg.inv(cameras.c2w[view]), points)
    projected = local @ cameras.K[view].T
    return projected[:, :2] / projected[:, 2:]


def test_random_rays_pass_through_pixel_centres(scene: Scene):
    cameras = off_centre(scene.train).cameras
    views = torch.arange(len(cameras)).repeat_interleave(50)
    rays = random_rays(cameras, views, torch.Generator().manual_seed(0))
    assert torch.equal(rays.origins, cameras.centres[views])
    for view in range(len(cameras)):
        pixels = pixel_of(cameras, view, rays[views == view])
        torch.testing.assert_close(pixels - 0.5, (pixels - 0.5).round(), atol=1e-4, rtol=0)
        assert pixels.min() > 0 and pixels.max() < 16
        assert len(pixels.round(decimals=1).unique(dim=0)) > 30


def test_ray_figure_is_within_the_box_and_a_stump_of_what_misses_it():
    rays = Rays(torch.tensor([[0.0, 0.0, -5.0], [0.0, 0.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    box = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    figure = ray_figure(rays, box, 3, 2.5)
    np.testing.assert_allclose(figure.approach, [[[0, 0, -5], [0, 0, -1]], [[0, 0, -5], [0, 2.5, -5]]])
    np.testing.assert_allclose(figure.inside, [[[0, 0, -1], [0, 0, 1]]])
    np.testing.assert_allclose(figure.samples, [[0, 0, -2 / 3], [0, 0, 0], [0, 0, 2 / 3]], atol=1e-6)


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
