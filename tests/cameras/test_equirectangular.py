"""Equirectangular panoramas, 360 degrees wide and 180 high."""

import math

import torch

from nerf_lightning.cameras import Cameras, Distortion, Lenses, Projection, look_at
from nerf_lightning.dataset.intrinsics import make_equirectangular

WIDTH, HEIGHT = 64, 32
DIRECTIONS = torch.nn.functional.normalize(torch.randn(5000, 3, generator=torch.Generator().manual_seed(0)), dim=1)


def panoramas(c2w: torch.Tensor, width: int = WIDTH, height: int = HEIGHT) -> Cameras:
    intrinsics = make_equirectangular(width, height)
    count = len(c2w)
    lenses = Lenses(torch.zeros(count, len(Distortion())), torch.full((count,), intrinsics.projection))
    K = torch.from_numpy(intrinsics.K).float().repeat(count, 1, 1)
    return Cameras(K, c2w, torch.tensor([[width, height]]).repeat(count, 1), lenses)


def random_pose_cameras() -> Cameras:
    """One panorama with a random pose."""
    eye, target = torch.tensor([0.3, -0.2, 0.5]), torch.tensor([1.0, 2.0, 0.1])
    return panoramas(look_at(eye, target, torch.tensor([0.1, 0.2, 1.0]))[None])


def test_project_equirectangular_inverts_rays():
    cameras = random_pose_cameras()
    rays = cameras.generate_view_rays(0)
    row, col = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    longitude = ((col + 0.5) / WIDTH - 0.5).flatten() * 2 * math.pi
    latitude = ((row + 0.5) / HEIGHT - 0.5).flatten() * math.pi
    local = [longitude.sin() * latitude.cos(), latitude.sin(), longitude.cos() * latitude.cos()]
    torch.testing.assert_close(rays.directions, torch.stack(local, 1) @ cameras.c2w[0, :3, :3].T, atol=1e-6, rtol=0)
    distance = torch.linspace(0.1, 9, len(rays))
    pixels, found, inside = cameras.project(rays.origins + rays.directions * distance[:, None], 0)
    torch.testing.assert_close(pixels, torch.stack([col, row], 2).view(-1, 2) + 0.5, atol=2e-3, rtol=0)
    torch.testing.assert_close(found, distance, atol=1e-5, rtol=1e-5)
    assert inside.all()


def test_project_equirectangular_sees_every_direction():
    cameras = random_pose_cameras()
    edges = [[0, 1.0, 0], [0, -1, 0], [-0.0, 0, -1], [1e-9, 0, -1], [-1e-9, 0, -1], [1e-9, 1, 0]]
    local = torch.cat([torch.tensor(edges), DIRECTIONS])
    pixels, _, inside = cameras.project(cameras.centers + local @ cameras.c2w[0, :3, :3].T, 0)
    assert inside.all(), "the poles and the seam too"
    col, row = pixels.long().unbind(1)
    seen = cameras.generate_rays(torch.zeros_like(row), row, col).directions @ cameras.c2w[0, :3, :3]
    assert float((seen * local).sum(1).min()) > math.cos(0.8 * 2 * math.pi / WIDTH), "half a pixel's diagonal"


def test_to_pinhole_equirectangular_is_90_degrees_wide():
    around = random_pose_cameras()
    lenses = Lenses(
        torch.cat([torch.ones(1, 11), torch.zeros(1, 11)]),
        torch.tensor([Projection.FISHEYE, Projection.EQUIRECTANGULAR]),
    )
    K = torch.cat([torch.tensor([[[30.0, 0, 7], [0, 31, 5], [0, 0, 1]]]), around.K])
    mixed = Cameras(K, around.c2w.repeat(2, 1, 1), torch.tensor([[15, 10], [WIDTH, HEIGHT]]), lenses)
    pinholes = mixed.to_pinhole()
    assert pinholes.lenses is None and torch.equal(pinholes.K[0], K[0]) and torch.equal(pinholes.c2w, mixed.c2w)
    assert pinholes.sizes.tolist() == [[15, 10], [20, 15]], "64 pixels for 360 degrees, the same at the center"
    assert pinholes.to_pinhole() is pinholes
    u = torch.tensor([0.0, 20.0])
    across = (u - pinholes.K[1, 0, 2]) / pinholes.K[1, 0, 0]
    torch.testing.assert_close(across, torch.tensor([-1.0, 1.0]), atol=0.03, rtol=0)
