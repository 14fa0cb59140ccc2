"""Camera layouts of known captures, invariant to frame, unit and order."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras import CameraLayout, classify_layout
from tests.helpers.camera_paths import CENTER, corridor, dome, forward, look_in_directions, pan, ring_poses, walk

AT_ARMS_LENGTH = look_in_directions(CENTER + 0.6 * pan()[:, :3, 2], torch.linspace(0, 6, 24), torch.zeros(24))
PANS = {"one": ring_poses(1), "pure pan": pan(), "half a pure pan": pan(degrees=180)}
WALKS = {"walk": walk(), "arm's length": AT_ARMS_LENGTH, "corridor": corridor()}
CASES = [
    *((f"ring {yaw}", ring_poses(yaw=yaw), CameraLayout.INWARD) for yaw in (0, 30)),
    ("high ring", ring_poses(yaw=15, elevation=60), CameraLayout.INWARD),
    ("half a ring", ring_poses(yaw=10, degrees=180), CameraLayout.INWARD),
    ("dome", dome(), CameraLayout.INWARD),
    *((f"forward {k}", forward(k), CameraLayout.FORWARD) for k in (-0.3, 0.0, 0.3)),
    *((name, c2w, CameraLayout.PAN) for name, c2w in PANS.items()),
    *((name, c2w, CameraLayout.WALK) for name, c2w in WALKS.items()),
]


@pytest.mark.parametrize(("c2w", "layout"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_classify_layout_in_any_frame_and_unit_is_the_same(c2w: torch.Tensor, layout: CameraLayout):
    assert classify_layout(c2w) == layout
    moved = torch.eye(4).double()
    moved[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix())
    moved = moved @ c2w
    moved[:, :3, 3] = 70 * moved[:, :3, 3] + 30
    assert classify_layout(moved) == layout
    assert classify_layout(c2w.float()) == layout


def test_classify_layout_with_points_separates_pan_and_walk():
    """The same poses with points at a table's and at a valley's distance."""
    c2w = pan(0.3)
    directions = torch.randn(500, 3, generator=torch.Generator().manual_seed(1)).double()
    directions = directions / directions.norm(dim=1, keepdim=True)
    assert classify_layout(c2w, CENTER + 100 * directions) == CameraLayout.PAN
    assert classify_layout(c2w, CENTER + 3 * directions) == CameraLayout.WALK
    wall = CENTER + torch.tensor([2.0, 0, 0])
    assert classify_layout(forward(0), wall + 0.2 * directions) == CameraLayout.FORWARD
    strip = forward(0)
    strip[:, 1, 3] = torch.linspace(-20, 20, len(strip)).double()
    assert classify_layout(strip, wall + directions * torch.tensor([0.1, 20, 1])) == CameraLayout.WALK
