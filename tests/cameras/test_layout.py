"""How cameras are laid out, against captures whose layout is known, in any frame, unit and order."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras import Layout, classify_layout
from tests.helpers.camera_paths import CENTRE, corridor, dome, forward, pan, ring, toward, walk

EVERY = [
    *((f"ring {yaw}", ring(yaw=yaw), Layout.INWARD) for yaw in (0, 30)),
    ("high ring", ring(yaw=15, elevation=60), Layout.INWARD),
    ("half a ring", ring(yaw=10, degrees=180), Layout.INWARD),
    ("dome", dome(), Layout.INWARD),
    *((f"forward {k}", forward(k), Layout.FORWARD) for k in (-0.3, 0.0, 0.3)),
    ("one", ring(1), Layout.PAN),
    ("pure pan", pan(), Layout.PAN),
    ("half a pure pan", pan(degrees=180), Layout.PAN),
    ("walk", walk(), Layout.WALK),
    ("arm's length", toward(CENTRE + 0.6 * pan()[:, :3, 2], torch.linspace(0, 6, 24), torch.zeros(24)), Layout.WALK),
    ("corridor", corridor(), Layout.WALK),
]


@pytest.mark.parametrize(("c2w", "layout"), [case[1:] for case in EVERY], ids=[case[0] for case in EVERY])
def test_classify_layout_any_frame_and_unit(c2w: torch.Tensor, layout: Layout):
    assert classify_layout(c2w) == layout
    moved = torch.eye(4).double()
    moved[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix())
    moved = moved @ c2w
    moved[:, :3, 3] = 70 * moved[:, :3, 3] + 30
    assert classify_layout(moved) == layout
    assert classify_layout(c2w.float()) == layout


def test_classify_layout_points_tell_pan_from_walk():
    """The same poses at a table's and at a valley's distance."""
    c2w = pan(0.3)
    around = torch.randn(500, 3, generator=torch.Generator().manual_seed(1)).double()
    around = around / around.norm(dim=1, keepdim=True)
    assert classify_layout(c2w, CENTRE + 100 * around) == Layout.PAN
    assert classify_layout(c2w, CENTRE + 3 * around) == Layout.WALK
    wall = CENTRE + torch.tensor([2.0, 0, 0])
    assert classify_layout(forward(0), wall + 0.2 * around) == Layout.FORWARD
    strip = forward(0)
    strip[:, 1, 3] = torch.linspace(-20, 20, len(strip)).double()
    assert classify_layout(strip, wall + around * torch.tensor([0.1, 20, 1])) == Layout.WALK
