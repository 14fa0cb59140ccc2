"""Photos of all directions, 360 degrees wide and 180 high."""

import math

import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras, Distortion, Lenses, Projection, look_at
from nerf_lightning.dataset.optics import equirectangular
from nerf_lightning.errors import InputError
from nerf_lightning.refine import Corrections

WIDTH, HEIGHT = 64, 32
DIRECTIONS = torch.nn.functional.normalize(torch.randn(5000, 3, generator=torch.Generator().manual_seed(0)), dim=1)


def panoramas(c2w: torch.Tensor, width: int = WIDTH, height: int = HEIGHT) -> Cameras:
    optics = equirectangular(width, height)
    count = len(c2w)
    lenses = Lenses(torch.zeros(count, len(Distortion())), torch.full((count,), optics.projection))
    K = torch.from_numpy(optics.K).float().repeat(count, 1, 1)
    return Cameras(K, c2w, torch.tensor([[width, height]]).repeat(count, 1), lenses)


def posed() -> Cameras:
    """One, that is turned and stands somewhere."""
    eye, target = torch.tensor([0.3, -0.2, 0.5]), torch.tensor([1.0, 2.0, 0.1])
    return panoramas(look_at(eye, target, torch.tensor([0.1, 0.2, 1.0]))[None])


@pytest.mark.parametrize(
    ("direction", "pixel"),
    [
        ((0, 0, 1), (32, 16)),
        ((1, 0, 0), (48, 16)),
        ((-1, 0, 0), (16, 16)),
        ((1, 0, 1), (40, 16)),
        ((0, 1, 1), (32, 24)),
        ((0, -1, 1), (32, 8)),
        ((-1e-3, 0, -1), (0, 16)),
        ((1e-3, 0, -1), (64, 16)),
    ],
)
def test_longitude_runs_to_the_right_and_latitude_down(direction: tuple[float, ...], pixel: tuple[float, float]):
    pixels, distance, inside = panoramas(torch.eye(4)[None]).project(torch.tensor([direction]).float(), 0)
    torch.testing.assert_close(pixels[0], torch.tensor(pixel).float(), atol=0.02, rtol=0)
    assert inside.all() and float(distance) == pytest.approx(math.hypot(*direction))


def test_every_pixel_is_seen_where_its_ray_leads():
    cameras = posed()
    rays = cameras.view_rays(0)
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


def test_every_direction_is_in_the_picture_and_its_pixel_looks_there():
    cameras = posed()
    edges = torch.tensor(
        [[0, 1.0, 0], [0, -1, 0], [0, 0, -1], [-0.0, 0, -1], [1e-9, 0, -1], [-1e-9, 0, -1], [1e-9, 1, 0]]
    )
    local = torch.cat([edges, DIRECTIONS])
    pixels, _, inside = cameras.project(cameras.centres + local @ cameras.c2w[0, :3, :3].T, 0)
    assert inside.all(), "the poles and the seam too"
    col, row = pixels.long().unbind(1)
    assert int(col.min()) >= 0 and int(col.max()) < WIDTH and int(row.min()) >= 0 and int(row.max()) < HEIGHT
    seen = cameras.rays(torch.zeros_like(row), row, col).directions @ cameras.c2w[0, :3, :3]
    assert float((seen * local).sum(1).min()) > math.cos(0.8 * 2 * math.pi / WIDTH), "half a pixel's diagonal"


def test_another_size_shows_all_directions_too():
    for small in (posed().resized((40, 20)), posed().scaled(0.5), posed()[torch.tensor([0, 0])]):
        assert small.K[0, 0, 0] * 2 * math.pi == pytest.approx(small.width)
        turn = small.c2w[0, :3, :3]
        pixels, _, inside = small.project(small.centres[0] + DIRECTIONS @ turn.T, 0)
        assert inside.all()
        torch.testing.assert_close(
            pixels[:, 1] / small.height, torch.asin(DIRECTIONS[:, 1]) / math.pi + 0.5, atol=1e-4, rtol=0
        )


def test_a_pixel_is_as_wide_as_its_angle():
    cameras = panoramas(torch.eye(4)[None])
    assert cameras.pixel_width(torch.tensor([0.0, -3.0, 0.0])) == pytest.approx(3 * 2 * math.pi / WIDTH)


def test_optics_see_every_pixel():
    assert equirectangular(WIDTH, HEIGHT).sees_every_pixel() and equirectangular(8192, 4096).sees_every_pixel()
    assert equirectangular(WIDTH, HEIGHT).bent and equirectangular(WIDTH, HEIGHT).perspective() is None


def test_the_pinhole_that_stands_for_one_is_a_right_angle_wide():
    around = posed()
    lenses = Lenses(
        torch.cat([torch.ones(1, 11), torch.zeros(1, 11)]),
        torch.tensor([Projection.FISHEYE, Projection.EQUIRECTANGULAR]),
    )
    K = torch.cat([torch.tensor([[[30.0, 0, 7], [0, 31, 5], [0, 0, 1]]]), around.K])
    mixed = Cameras(K, around.c2w.repeat(2, 1, 1), torch.tensor([[15, 10], [WIDTH, HEIGHT]]), lenses)
    pinholes = mixed.as_pinholes()
    assert pinholes.lenses is None and torch.equal(pinholes.K[0], K[0]) and torch.equal(pinholes.c2w, mixed.c2w)
    assert pinholes.sizes.tolist() == [[15, 10], [20, 15]], "64 pixels for 360 degrees, the same at the centre"
    assert pinholes.as_pinholes() is pinholes
    u = torch.tensor([0.0, 20.0])
    across = (u - pinholes.K[1, 0, 2]) / pinholes.K[1, 0, 0]
    torch.testing.assert_close(across, torch.tensor([-1.0, 1.0]), atol=0.03, rtol=0)


def test_what_needs_an_optical_axis_is_refused():
    cameras, bounds = posed(), Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    with pytest.raises(InputError, match=r"refine.focal: found true, with .* all directions, expected false"):
        Corrections(cameras, bounds, focal=True)
    with pytest.raises(
        InputError, match=r"refine.vignetting: found true, with photos of all directions, expected false"
    ):
        Corrections(cameras, bounds, vignetting=True)
