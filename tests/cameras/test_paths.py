"""Camera paths stay near the photos for every layout, without degenerate poses."""

import math

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Cameras, find_pivot, make_orbit_path, make_spiral_path, start_at_middle
from nerf_lightning.dataset.region import find_region
from tests.helpers.camera_paths import CENTER, RADIUS, UP, corridor, dome, forward, pan, ring_poses, walk

LAYOUT_POSES = {
    "ring": ring_poses(), "framed to one side": ring_poses(yaw=20), "arc": ring_poses(degrees=150), "dome": dome(),
    "converging": forward(-0.3), "diverging": forward(0.2), "pan": pan(), "half a pan": pan(degrees=150),
    "walk": walk(), "corridor": corridor(), "one": ring_poses(1), "two": ring_poses(2),
    "all in one pose": ring_poses(1).repeat(5, 1, 1),
}  # fmt: skip


def make_cameras(c2w: torch.Tensor) -> Cameras:
    return Cameras.pinhole(torch.eye(3).repeat(len(c2w), 1, 1) * 20, c2w.float(), 32, 24)


def make_orbit(c2w: torch.Tensor, frames: int) -> Cameras:
    region = find_region(c2w)
    return make_orbit_path(make_cameras(c2w), region.layout, region.center, frames)


def test_path_starts_at_middle_of_an_arc():
    orbit = make_orbit(ring_poses(degrees=150), 60)
    started = start_at_middle(orbit)
    ends = normalize(torch.stack([orbit.c2w[0, :3, 2], orbit.c2w[30, :3, 2]]), dim=1)
    cosines = ends @ started.c2w[0, :3, 2]
    torch.testing.assert_close(cosines[0], cosines[1], atol=0.1, rtol=0)
    assert torch.equal(started.centers.sort(0).values, orbit.centers.sort(0).values)
    assert torch.equal(started.c2w[1], orbit.c2w[(orbit.c2w == started.c2w[0]).all((1, 2)).nonzero()[0, 0] + 1])
    assert len(start_at_middle(orbit[:1])) == 1


@pytest.mark.parametrize("frames", [1, 60])
@pytest.mark.parametrize("c2w", LAYOUT_POSES.values(), ids=LAYOUT_POSES.keys())
def test_make_orbit_path_and_spiral_stay_near_the_photos(c2w: torch.Tensor, frames: int):
    cameras = make_cameras(c2w)
    orbit = make_orbit(c2w, frames)
    spiral = make_spiral_path(orbit, frames)
    for path in (orbit, spiral):
        assert len(path) == frames
        R = path.c2w[:, :3, :3]
        torch.testing.assert_close(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-4, rtol=0)
        assert (torch.linalg.det(R) > 0).all() and path.c2w.isfinite().all()
        assert (path.c2w[:, :3, 1] @ UP.float()).max() < 0.1, "upright"
    distances = torch.cdist(orbit.centers, cameras.centers)
    spacing = torch.cdist(cameras.centers, cameras.centers).fill_diagonal_(math.inf).amin(1)
    size = float((cameras.centers - cameras.centers.mean(0)).norm(dim=1).max())
    limit = max(0.35 * size, float(spacing[spacing < math.inf].max()) if len(c2w) > 1 else 0.0)
    assert float(distances.amin(1).max()) <= limit + 1e-3, "no view far from all photos"
    # Each view looks within 45 degrees of a photo's direction.
    assert (orbit.c2w[:, :3, 2] @ cameras.c2w[:, :3, 2].T).amax(1).min() > 0.7
    if frames == 60:
        step = (orbit.centers.roll(-1, 0) - orbit.centers).norm(dim=1)
        assert float(step.max()) < 0.25 * max(size, 1e-3), "no jump, from the last to the first neither"
    pivot = find_pivot(orbit)
    assert pivot.isfinite().all() and float((pivot - orbit.centers[0]).norm()) > 1e-3


@pytest.mark.parametrize("yaw", [0, 20])
def test_make_orbit_path_of_ring_is_a_full_turn(yaw: int):
    orbit = make_orbit(ring_poses(yaw=yaw), 8)
    assert (orbit.width, orbit.height) == (32, 24) and torch.equal(orbit.K, make_cameras(ring_poses()).K[:8])
    offset = orbit.centers - CENTER.float()
    torch.testing.assert_close(offset.norm(dim=1), torch.full((8,), RADIUS), atol=0.05, rtol=0)
    torch.testing.assert_close(orbit.c2w[:, :3, 2], -normalize(offset, dim=1), atol=0.05, rtol=0)
    turn = torch.atan2(offset[:, 1], offset[:, 0])
    steps = torch.remainder(turn.roll(-1) - turn, 2 * math.pi)
    torch.testing.assert_close(steps, torch.full((8,), math.pi / 4), atol=0.05, rtol=0)
    torch.testing.assert_close(find_pivot(orbit), CENTER.float(), atol=0.05, rtol=0)


def test_make_orbit_path_of_portrait_photos_is_upright_and_portrait():
    quarter = torch.eye(4, dtype=torch.float64)[[1, 0, 2, 3]] * torch.tensor([1.0, -1, 1, 1])
    orbit = make_orbit(ring_poses() @ quarter, 8)
    assert (orbit.width, orbit.height) == (24, 32)
    assert (orbit.c2w[:, :3, 1] @ UP.float()).max() < -0.5, "upright"


def test_make_orbit_path_of_arc_and_half_pan_swings():
    arc, pans = make_orbit(ring_poses(24, degrees=150), 60), make_orbit(pan(degrees=150), 60)
    offset = arc.centers - CENTER.float()
    torch.testing.assert_close(offset.norm(dim=1), torch.full((60,), RADIUS), atol=0.02, rtol=0)
    assert float((pans.centers - CENTER.float()).abs().max()) < 1e-6
    for direction in (offset, pans.c2w[:, :3, 2]):
        turn = torch.atan2(direction[:, 1], direction[:, 0]).rad2deg()
        assert turn.min() == pytest.approx(0, abs=1) and turn.max() == pytest.approx(150 * 23 / 24, abs=1)


@pytest.mark.parametrize(("degrees", "outermost", "innermost"), [(150, 50, 25), (360, 60, 25)])
def test_make_spiral_path_of_ring_winds_in(degrees: float, outermost: float, innermost: float):
    orbit = make_orbit(ring_poses(24, degrees=degrees), 60)
    offset = make_spiral_path(orbit, 60).centers - CENTER.float()
    middle = normalize(orbit.centers.mean(0) - CENTER.float(), dim=0)
    torch.testing.assert_close(offset.norm(dim=1), torch.full((60,), RADIUS), atol=0.05, rtol=0)
    away = torch.acos(normalize(offset, dim=1) @ middle).rad2deg()
    assert away[:8].max() > outermost and away[25:36].max() < innermost
