"""Rays through lenses, against OpenCV."""

import cv2
import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Cameras, Distortion, Lenses, Projection

WIDTH, HEIGHT = 640, 480
K = np.array([[520.0, 0, 322.3], [0, 510, 236.7], [0, 0, 1]])
PERSPECTIVE, FISHEYE, _ = Projection
MODELS = {
    "radial": (Distortion(k1=-0.2, k2=0.05), PERSPECTIVE),
    "barrel": (Distortion(k1=0.1, k2=-0.02, p1=0.004, p2=-0.006, k3=0.003), PERSPECTIVE),
    "rational": (Distortion(k1=0.1, k2=0.03, k3=0.01, d1=0.12, d2=0.01, d3=0.002, p1=0.004, p2=-0.006), PERSPECTIVE),
    "prism": (Distortion(k1=-0.1, s1=0.01, s2=-0.02), PERSPECTIVE),
    "fisheye": (Distortion(k1=0.05, k2=-0.02, k3=0.01, k4=-0.003), FISHEYE),
}
STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)


def make_lens_cameras(name: str) -> Cameras:
    distortion, projection = MODELS[name]
    lenses = Lenses(torch.tensor([distortion]), torch.tensor([projection]))
    return Cameras(torch.from_numpy(K).float()[None], torch.eye(4)[None], torch.tensor([[WIDTH, HEIGHT]]), lenses)


def opencv_distortion(name: str, row: torch.Tensor, col: torch.Tensor) -> np.ndarray:
    """Directions by OpenCV, whose pixel centers are at integers."""
    d, projection = MODELS[name]
    seen = torch.stack([col, row], dim=1).double().numpy()[:, None]
    intrinsics = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    if projection == FISHEYE:
        flat = cv2.fisheye.undistortPoints(seen, intrinsics, np.array(d[:4]), criteria=STOP)
    else:
        four = np.array([d.k1, d.k2, d.p1, d.p2, d.k3, d.d1, d.d2, d.d3, d.s1, 0, d.s2, 0])
        flat = cv2.undistortPoints(seen, intrinsics, four, None, None, None, STOP)
    return np.concatenate([flat[:, 0], np.ones((len(flat), 1))], axis=1)


@pytest.mark.parametrize("name", MODELS)
def test_generate_rays_distorted_agree_with_opencv_and_project(name: str):
    row, col = torch.randint(HEIGHT, (5000,)), torch.randint(WIDTH, (5000,))
    rays = make_lens_cameras(name).generate_rays(torch.zeros_like(row), row, col).directions.double().numpy()
    expected = opencv_distortion(name, row, col)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    angle = np.linalg.norm(np.cross(rays, expected), axis=1)
    assert (np.sum(rays * expected, axis=1) > 0).all() and angle.max() < 1e-5
    points = torch.from_numpy(rays).float() * torch.linspace(0.5, 9, len(rays))[:, None]
    pixels, depth, inside = make_lens_cameras(name).project(points, 0)
    torch.testing.assert_close(pixels, torch.stack([col, row], dim=1) + 0.5, atol=2e-3, rtol=0)
    assert inside.all() and (depth > 0).all()


def test_project_fisheye_shows_points_at_more_than_90_degrees():
    lens = Lenses(torch.tensor([Distortion(k1=0.01)]), torch.tensor([FISHEYE]))
    wide = torch.tensor([[[200.0, 0, 322], [0, 200, 237], [0, 0, 1]]])
    cameras = Cameras(wide, torch.eye(4)[None], torch.tensor([[WIDTH, HEIGHT]]), lens)
    rays = cameras.generate_view_rays(0)
    assert float(rays.directions[:, 2].min()) < -0.1
    pixels, _, inside = cameras.project(3 * rays.directions[::997], 0)
    assert inside.all()
    torch.testing.assert_close(pixels[1], torch.tensor([997 % WIDTH + 0.5, 997 // WIDTH + 0.5]), atol=5e-3, rtol=0)


def test_project_beyond_visible_radius_is_outside():
    # This polynomial leads back into the picture from far outside.
    lens = Lenses(torch.tensor([Distortion(k1=-0.2)]), torch.tensor([PERSPECTIVE]))
    cameras = Cameras(torch.from_numpy(K).float()[None], torch.eye(4)[None], torch.tensor([[WIDTH, HEIGHT]]), lens)
    outside = torch.tensor([[2.2, 0.0, 1.0]])
    assert not cameras.project(outside, 0)[2] and not cameras.project(torch.tensor([[0.0, 0.0, -1.0]]), 0)[2]
    assert cameras.project(torch.tensor([[0.1, 0.1, 1.0]]), 0)[2]
