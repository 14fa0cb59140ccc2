"""Region of interest of captures with known subject and depth."""

import logging
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import CameraLayout, Cameras
from nerf_lightning.dataset import PhotoLoadOptions, Scene, Views, open_scene
from nerf_lightning.dataset.region import PAN_DEPTH, find_region
from tests.helpers.camera_paths import CENTER, RADIUS, forward, pan, ring_poses, walk
from tests.helpers.scene_writers import colmap_cameras, write_colmap, write_photos, write_transforms

WIDTH, HEIGHT, FOCAL = 160, 120, 140.0


def sample_box(low: tuple[float, ...], high: tuple[float, ...], count: int = 400) -> Float[Tensor, "P 3"]:
    """Points in a box around `CENTER`."""
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return CENTER + torch.tensor(low) + share * (torch.tensor(high) - torch.tensor(low))


def sample_sphere(radius: float) -> Float[Tensor, "P 3"]:
    """Points on a sphere around `CENTER`."""
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return CENTER + radius * points / points.norm(dim=1, keepdim=True)


def size_of(scene: Scene) -> float:
    """Unit of the scene, in its file's unit."""
    return float(torch.linalg.det(scene.to_source[:3, :3].double()) ** (1 / 3))


def make_views(c2w: Float[Tensor, "V 4 4"], draw: Callable[[Cameras], Tensor] | None = None) -> Views:
    """Photos rendered by `draw`, or of noise."""
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]).repeat(len(c2w), 1, 1)
    cameras = Cameras.pinhole(K, c2w.float(), WIDTH, HEIGHT)
    noise = torch.randint(0, 255, (len(c2w), HEIGHT, WIDTH, 3), generator=torch.manual_seed(0)).to(torch.uint8)
    return Views.from_images(noise if draw is None else draw(cameras), cameras)


def write_folder(folder: Path, c2w: Float[Tensor, "V 4 4"], draw: Callable[[Cameras], Tensor] | None = None) -> Path:
    """transforms.json with photos rendered by `draw`, or of noise."""
    views = make_views(c2w, draw)
    write_transforms(folder / "transforms.json", views, write_photos(folder, views), w=WIDTH, h=HEIGHT)
    return folder


@pytest.mark.parametrize(("yaw", "distance"), [(0, 0.5), (10, 2.0), (20, 1.0)])
def test_find_region_ring_is_centered_on_its_subject(yaw: int, distance: float):
    radius = RADIUS * distance
    for elevation in (10.0, 25.0, 40.0):
        region = find_region(ring_poses(32, yaw, elevation, radius=radius))
        assert region.layout == CameraLayout.INWARD and region.has_depth
        assert float((region.center - CENTER).norm()) < 0.1 * radius
        assert region.unit == pytest.approx(radius, rel=0.05)
        shift = torch.tensor([449500.25, 5411200.75, 210.5], dtype=torch.float64)  # a georeferenced frame
        there = ring_poses(32, yaw, elevation, radius=radius)
        there[:, :3, 3] += shift
        far = find_region(there)
        torch.testing.assert_close(far.center - shift, region.center, atol=1e-6, rtol=0)
        assert far.layout == region.layout and far.unit == pytest.approx(region.unit)


def test_find_region_arc_is_centered_by_points():
    """A subject, and a wall behind it in few of the photos."""
    points = torch.cat([sample_box((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3)), sample_box((-6, -6, -1), (-5, 6, 4))])
    region = find_region(ring_poses(24, 15, degrees=150), points)
    assert float((region.center - CENTER).norm()) < 0.1 * RADIUS
    assert region.unit == pytest.approx(RADIUS, rel=0.1)


@pytest.mark.parametrize("diverging", [-0.3, 0.2])
def test_find_region_forward_is_centered_on_points(diverging: float):
    region = find_region(forward(diverging), sample_box((2.5, -1, -0.7), (3.5, 1, 0.7)))
    assert region.has_subject
    assert float((region.center - CENTER - torch.tensor([3.0, 0, 0])).norm()) < 0.4
    assert region.unit == pytest.approx(3.0, rel=0.15)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_find_region_pan_is_centered_on_its_camera(noise: float):
    region = find_region(pan(noise), sample_sphere(3.0))
    assert region.layout == CameraLayout.PAN and region.has_depth and not region.has_subject
    assert float((region.center - CENTER).norm()) < noise + 1e-9
    assert region.unit == pytest.approx(3.0 / PAN_DEPTH, rel=0.05)


def test_find_region_walk_holds_its_cameras():
    c2w = walk()
    region = find_region(c2w, c2w[:, :3, 3] + 3 * c2w[:, :3, 2])
    inside = ((c2w[:, :3, 3] - region.center).abs() <= region.unit).all(1).double().mean()
    assert region.layout == CameraLayout.WALK and region.has_depth and inside >= 0.8
    assert 2.5 < region.unit < 8.0


def render_inside_ball(cameras: Cameras, radius: float = 3.0) -> UInt8[Tensor, "V H W 3"]:
    """Photos from inside a ball around the origin with a coarse noise texture."""
    paint = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (512, 1024, 3)).astype(np.float32), (0, 0), 3)
    paint = (128 + 12 * (paint - paint.mean())).clip(0, 255).astype(np.uint8)
    images = []
    for view in range(len(cameras)):
        rays = cameras.generate_view_rays(view)
        along = (rays.origins * rays.directions).sum(1, keepdim=True)
        depth = -along + (along.square() - rays.origins.square().sum(1, keepdim=True) + radius**2).sqrt()
        x, y, z = (rays.origins + depth * rays.directions).view(HEIGHT, WIDTH, 3).numpy().transpose(2, 0, 1) / radius
        across, down = (np.arctan2(y, x) / (2 * math.pi) + 0.5) * 1023, np.arccos(z.clip(-1, 1)) / math.pi * 511
        images.append(cv2.remap(paint, across.astype(np.float32), down.astype(np.float32), cv2.INTER_LINEAR))
    return torch.from_numpy(np.stack(images))


@pytest.mark.parametrize(
    ("c2w", "layout"),
    [(pan(0.05, seed=1), CameraLayout.PAN), (forward(0.1), CameraLayout.FORWARD)],
    ids=["pan", "forward"],
)
def test_open_scene_without_depth_matches_photos(c2w: torch.Tensor, layout: CameraLayout, tmp_path: Path):
    c2w = c2w.clone()
    c2w[:, :3, 3] -= CENTER
    scene = open_scene(str(write_folder(tmp_path, c2w, render_inside_ball)), options=PhotoLoadOptions(holdout=8))
    assert size_of(scene) * (PAN_DEPTH if layout == CameraLayout.PAN else 1) == pytest.approx(3, rel=0.2)
    assert scene.points is not None and len(scene.points) > 50
    places = scene.points.double() @ scene.to_source[:3, :3].double().T + scene.to_source[:3, 3]
    assert float((places.norm(dim=1) - 3).abs().median()) < 0.3, "most points lie on the ball"


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_open_scene_pan_unknown_depth_warns(noise: float, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.WARNING):
        scene = open_scene(str(write_folder(tmp_path, pan(noise))))
    assert ("determine the depth" in caplog.text) == (noise > 0)
    assert scene.bounds.unbounded and scene.bounds.near is None
    assert float((scene.to_source[:3, 3].double() - CENTER).norm()) < 0.05


def test_open_scene_colmap_points_are_in_the_scenes_frame(tmp_path: Path):
    views, points = make_views(ring_poses(16)), sample_box((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3))
    names = write_photos(tmp_path / "images", views)
    write_colmap(tmp_path / "sparse/0", views.cameras.c2w.numpy(), names, colmap_cameras(views), points=points.numpy())
    scene = open_scene(str(tmp_path))
    assert scene.points is not None
    back = scene.points.double() @ scene.to_source[:3, :3].double().T + scene.to_source[:3, 3]
    np.testing.assert_allclose(np.sort(back.numpy(), 0), np.sort(points.numpy(), 0), atol=1e-4)
    assert float(scene.points.norm(dim=1).max()) < 0.6 / RADIUS
