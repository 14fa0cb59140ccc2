"""What the page about a scene draws, against the scene's own geometry."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras, Rays, pixel_to_camera, transform
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.view.drawing import (
    frusta,
    overview,
    path_segments,
    random_rays,
    ray_figure,
    through,
)


def some(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def off_centre(views: Views) -> Views:
    """The same photos through a lens whose axis meets them 2 pixels right of and 4 above the middle; no square pixels."""
    K = torch.tensor([[20.0, 0.0, 10.0], [0.0, 25.0, 4.0], [0.0, 0.0, 1.0]])
    return replace(views, cameras=replace(views.cameras, K=K.expand_as(views.cameras.K)))


def test_frusta_are_where_the_cameras_are(scene: Scene):
    drawn = list(frusta(scene.train, "training", 8))
    assert [f.name for f in drawn] == ["training 0", "training 1", "training 2", "training 3"]
    for frustum, c2w, K in zip(drawn, scene.train.cameras.c2w, scene.train.cameras.K, strict=True):
        assert np.array_equal(frustum.c2w, c2w.numpy())
        assert frustum.fov == pytest.approx(2 * math.atan(8 / float(K[1, 1])))
        assert frustum.aspect == pytest.approx(1)
        assert frustum.photo.shape == (8, 8, 4)


@pytest.mark.parametrize("channels", [3, 4])
def test_frusta_keep_photos_in_place_when_the_axis_is_off_centre(scene: Scene, channels: int):
    """Every pixel of the photo lies in the pyramid's base where the camera's own K puts it."""
    views = off_centre(Views.of(scene.train.images[..., :channels].contiguous(), scene.train.cameras))
    frustum = next(frusta(views, "training", 16))
    h, w, _ = frustum.photo.shape
    assert (h, w) == (16 + 8, 16 + 4)
    assert np.array_equal(frustum.photo[8:, :16, :channels], views.images[0].numpy())
    assert not frustum.photo[:8].any() and not frustum.photo[:, 16:].any()
    down = math.tan(frustum.fov / 2)
    across = down * frustum.aspect
    row, col = 3, 5
    expected = pixel_to_camera(views.cameras.K[0], torch.tensor([col + 0.5, row + 0.5]), torch.ones(()))
    at = ((2 * (col + 0.5) / w - 1) * across, (2 * (row + 8 + 0.5) / h - 1) * down, 1)
    assert at == pytest.approx(expected.tolist(), abs=1e-6)


def pixel_of(cameras: Cameras, view: int, rays: Rays) -> torch.Tensor:
    """Where a view sees points a unit down its rays; continuous pixels [R, 2]."""
    points = rays.origins + rays.directions
    local = transform(torch.linalg.inv(cameras.c2w[view]), points)
    projected = local @ cameras.K[view].T
    return projected[:, :2] / projected[:, 2:]


def test_random_rays_pass_through_pixel_centres(scene: Scene):
    cameras = off_centre(scene.train).cameras
    views = torch.arange(len(cameras)).repeat_interleave(50)
    rays = random_rays(cameras, views, some())
    assert torch.equal(rays.origins, cameras.centres[views])
    for view in range(len(cameras)):
        pixels = pixel_of(cameras, view, rays[views == view])
        torch.testing.assert_close(pixels - 0.5, (pixels - 0.5).round(), atol=1e-4, rtol=0)
        assert pixels.min() > 0 and pixels.max() < 16
        assert len(pixels.round(decimals=1).unique(dim=0)) > 30


@pytest.mark.parametrize("jitter", [False, True])
def test_ray_figure_samples_lie_on_their_rays_within_the_box(scene: Scene, jitter: bool):
    rays = random_rays(scene.train.cameras, torch.full((40,), 1), some())
    figure = ray_figure(rays, scene.bounds, 16, 4.0, some() if jitter else None)
    assert len(figure.approach) == 40
    assert np.array_equal(figure.approach[:, 0], rays.origins.numpy())
    hits = len(figure.inside)
    assert 0 < hits <= 40
    assert figure.samples.shape == (16 * hits, 3)
    low, high = scene.bounds.aabb.numpy()
    assert (figure.samples > low - 1e-4).all() and (figure.samples < high + 1e-4).all()
    for ends, points in zip(figure.inside, figure.samples.reshape(hits, 16, 3), strict=True):
        along = (points - ends[0]) @ (ends[1] - ends[0]) / np.sum((ends[1] - ends[0]) ** 2)
        np.testing.assert_allclose(points, ends[0] + along[:, None] * (ends[1] - ends[0]), atol=1e-5)
        assert (np.diff(along) > 0).all() and along[0] > 0 and along[-1] < 1
        assert jitter != np.allclose(along, (np.arange(16) + 0.5) / 16, atol=1e-4)


def test_ray_figure_missing_rays_are_a_stump_without_samples():
    rays = Rays(torch.tensor([[0.0, 0.0, -5.0], [0.0, 0.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    box = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    figure = ray_figure(rays, box, 3, 2.5, None)
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
    frustum = next(frusta(scene.train, "training", 8))
    view = through(frustum, 4.0, np.array([0.0, 0.0, 1.0], np.float32))
    right, down, ahead, centre = scene.train.cameras.c2w[0, :3].T.numpy()
    np.testing.assert_allclose(view.position, centre)
    np.testing.assert_allclose(view.look_at, centre + 4 * ahead, rtol=1e-6)
    assert abs(view.up @ right) < 1e-6  # no roll
    assert view.up @ down < 0
    np.testing.assert_allclose(through(frustum, 4.0, down).up, -down)  # taken upside down
