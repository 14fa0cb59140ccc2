"""What the page about a scene draws, against the scene's own geometry."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras, Rays, transform_points
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.view.geometry import (
    build_ray_figure,
    compute_path_segments,
    get_overview_viewpoint,
    get_photo_viewpoint,
    iterate_frusta,
    sample_random_rays,
)


def off_center(views: Views) -> Views:
    """The same photos through a lens whose axis meets them 2 pixels right of and 4 above the middle; no square pixels."""
    K = torch.tensor([[20.0, 0.0, 10.0], [0.0, 25.0, 4.0], [0.0, 0.0, 1.0]])
    return replace(views, cameras=replace(views.cameras, K=K.expand_as(views.cameras.K)))


def test_iterate_frusta_match_cameras(scene: Scene):
    drawn = list(iterate_frusta(scene.train, 8))
    assert [f.name for f in drawn] == ["photo 0", "photo 1", "photo 2", "photo 3"]
    for frustum, c2w, K in zip(drawn, scene.train.cameras.c2w, scene.train.cameras.K, strict=True):
        assert np.array_equal(frustum.c2w, c2w.numpy())
        assert frustum.fov == pytest.approx(2 * math.atan(8 / float(K[1, 1])))
        assert frustum.aspect == pytest.approx(1)
        assert frustum.photo.shape == (8, 8, 4)


def pixel_of(cameras: Cameras, view: int, rays: Rays) -> torch.Tensor:
    """Where a view sees points a unit down its rays; continuous pixels [R, 2]."""
    points = rays.origins + rays.directions
    local = transform_points(torch.linalg.inv(cameras.c2w[view]), points)
    projected = local @ cameras.K[view].T
    return projected[:, :2] / projected[:, 2:]


def test_sample_random_rays_pass_through_pixel_centers(scene: Scene):
    cameras = off_center(scene.train).cameras
    views = torch.arange(len(cameras)).repeat_interleave(50)
    rays = sample_random_rays(cameras, views, torch.Generator().manual_seed(0))
    assert torch.equal(rays.origins, cameras.centers[views])
    for view in range(len(cameras)):
        pixels = pixel_of(cameras, view, rays[views == view])
        torch.testing.assert_close(pixels - 0.5, (pixels - 0.5).round(), atol=1e-4, rtol=0)
        assert pixels.min() > 0 and pixels.max() < 16
        assert len(pixels.round(decimals=1).unique(dim=0)) > 30


def test_build_ray_figure_clips_rays_to_box():
    rays = Rays(torch.tensor([[0.0, 0.0, -5.0], [0.0, 0.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    box = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    figure = build_ray_figure(rays, box, 3, 2.5)
    np.testing.assert_allclose(figure.approach, [[[0, 0, -5], [0, 0, -1]], [[0, 0, -5], [0, 2.5, -5]]])
    np.testing.assert_allclose(figure.inside, [[[0, 0, -1], [0, 0, 1]]])
    np.testing.assert_allclose(figure.samples, [[0, 0, -2 / 3], [0, 0, 0], [0, 0, 2 / 3]], atol=1e-6)


def test_compute_path_segments_close_only_rings(scene: Scene):
    ring = compute_path_segments(scene.orbit)
    assert len(ring) == 6
    assert np.array_equal(ring[-1, 1], ring[0, 0])
    assert len(compute_path_segments(scene.orbit[:3])) == 2
    assert compute_path_segments(scene.orbit[:1]).shape == (0, 2, 3)


def test_get_overview_viewpoint_sees_cameras_and_box(scene: Scene):
    view = get_overview_viewpoint(scene)
    ahead = view.look_at - view.position
    ahead /= np.linalg.norm(ahead)
    np.testing.assert_allclose(view.up, [0, 0, 1], atol=1e-5)
    for point in torch.cat([scene.train.cameras.centers, scene.val.cameras.centers, scene.bounds.aabb]).numpy():
        toward = point - view.position
        assert toward @ ahead / np.linalg.norm(toward) >= math.cos(view.fov / 2) - 1e-6


def test_get_photo_viewpoint_matches_camera(scene: Scene):
    frustum = next(iterate_frusta(scene.train, 8))
    view = get_photo_viewpoint(frustum, 4.0, np.array([0.0, 0.0, 1.0], np.float32))
    right, down, ahead, center = scene.train.cameras.c2w[0, :3].T.numpy()
    np.testing.assert_allclose(view.position, center)
    np.testing.assert_allclose(view.look_at, center + 4 * ahead, rtol=1e-6)
    assert abs(view.up @ right) < 1e-6  # no roll
    assert view.up @ down < 0
    np.testing.assert_allclose(get_photo_viewpoint(frustum, 4.0, down).up, -down)  # taken upside down
