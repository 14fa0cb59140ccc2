"""Turns against the matrix exponential, and shifts of pixels against cameras that really moved."""

import torch
from torch import Tensor

from nerf_lightning.refine.gauge import gauge_directions, pixel_shifts, precondition, rotate


def cross(turns: Tensor) -> Tensor:
    """Matrices that take the cross product with these vectors."""
    found = torch.zeros(len(turns), 3, 3, dtype=turns.dtype)
    found[:, [2, 0, 1], [1, 2, 0]] = turns
    return found - found.mT


def test_turned_any_angle_matches_rotation_matrix():
    turns = torch.randn(6, 3).double() * torch.tensor([0, 1e-9, 1e-4, 1e-2, 0.5, 2.5]).double()[:, None]
    vectors = torch.randn(6, 3).double()
    expected = (torch.linalg.matrix_exp(cross(turns)) @ vectors[..., None]).squeeze(2)
    torch.testing.assert_close(rotate(vectors, turns), expected)
    assert torch.autograd.gradcheck(rotate, (vectors.requires_grad_(), turns.requires_grad_()))


def test_pixel_shifts_match_moved_cameras():
    centres, places, focals = 3 * torch.randn(4, 3).double(), 0.3 * torch.randn(20, 3).double(), torch.full((4,), 90.0)
    motions = 1e-6 * torch.randn(4, 6).double()
    before = places - centres[:, None]
    back = torch.linalg.matrix_exp(cross(-motions[:, :3]))
    after = (places - centres[:, None] - motions[:, None, 3:]) @ back.mT
    expected = 90 * (torch.nn.functional.normalize(after, dim=2) - torch.nn.functional.normalize(before, dim=2))
    found = (pixel_shifts(centres, focals.double(), places) @ motions[:, None, :, None]).squeeze(3)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-9)


def test_drifts_with_content_leave_views_unchanged():
    centres, place = 3 * torch.nn.functional.normalize(torch.randn(5, 3).double(), dim=1), torch.randn(3).double()
    centres, places = centres + place, place + 0.2 * torch.randn(50, 3).double()
    found, shifts = gauge_directions(centres, place), pixel_shifts(centres, torch.full((5,), 90.0).double(), places)
    axes = torch.eye(3).double().expand(50, 3, 3)
    turns = torch.linalg.cross(axes, (places - place)[:, :, None].expand(50, 3, 3), dim=1)
    content = torch.cat([axes, turns, (places - place)[:, :, None], axes], dim=2)
    follows = (
        pixel_shifts(centres, torch.full((5,), 90.0).double(), places)[..., 3:] @ -content
    )  # as a move of the camera, turned
    left = (shifts @ found[:, None] + follows).square().mean((1, 2)).sqrt() / follows.square().mean((1, 2)).sqrt()
    torch.testing.assert_close(left[:, :7], torch.zeros(5, 7).double(), atol=1e-9, rtol=0)
    assert (left[:, 7:] < 0.2).all(), "far cameras see hardly more than a shift"


def test_whitening_motion_shifts_places_by_a_pixel():
    centres, places = 3 * torch.nn.functional.normalize(torch.randn(5, 3).double(), dim=1), torch.rand(500, 3).double()
    shifts = pixel_shifts(centres, torch.full((5,), 200.0).double(), places - 0.5)
    free, damped = (
        (shifts @ precondition(shifts, damping)[:, None]).square().sum(2).mean(1).sqrt() for damping in (1e-9, 1.0)
    )
    torch.testing.assert_close(free, torch.ones(5, 6).double(), rtol=1e-3, atol=0)
    assert (damped < 1).all() and (damped > 0.01).all()
