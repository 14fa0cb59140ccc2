"""Rotations against the matrix exponential, and projection Jacobians against moved cameras."""

import torch
from torch import Tensor

from nerf_lightning.refine.gauge import (
    compute_gauge_modes,
    compute_preconditioner,
    compute_projection_jacobian,
    rotate_axis_angle,
)


def cross(rotations: Tensor) -> Tensor:
    """Cross-product matrices of vectors."""
    found = torch.zeros(len(rotations), 3, 3, dtype=rotations.dtype)
    found[:, [2, 0, 1], [1, 2, 0]] = rotations
    return found - found.mT


def test_rotate_axis_angle_any_angle_matches_rotation_matrix():
    rotations = torch.randn(6, 3).double() * torch.tensor([0, 1e-9, 1e-4, 1e-2, 0.5, 2.5]).double()[:, None]
    vectors = torch.randn(6, 3).double()
    expected = (torch.linalg.matrix_exp(cross(rotations)) @ vectors[..., None]).squeeze(2)
    torch.testing.assert_close(rotate_axis_angle(vectors, rotations), expected)
    assert torch.autograd.gradcheck(rotate_axis_angle, (vectors.requires_grad_(), rotations.requires_grad_()))


def test_projection_jacobian_matches_finite_differences():
    centers, places, focals = 3 * torch.randn(4, 3).double(), 0.3 * torch.randn(20, 3).double(), torch.full((4,), 90.0)
    pose_adjustment = 1e-6 * torch.randn(4, 6).double()
    before = places - centers[:, None]
    back = torch.linalg.matrix_exp(cross(-pose_adjustment[:, :3]))
    after = (places - centers[:, None] - pose_adjustment[:, None, 3:]) @ back.mT
    expected = 90 * (torch.nn.functional.normalize(after, dim=2) - torch.nn.functional.normalize(before, dim=2))
    jacobian = compute_projection_jacobian(centers, focals.double(), places)
    found = (jacobian @ pose_adjustment[:, None, :, None]).squeeze(3)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-9)


def test_gauge_modes_moved_with_content_leave_views_unchanged():
    centers, place = 3 * torch.nn.functional.normalize(torch.randn(5, 3).double(), dim=1), torch.randn(3).double()
    centers, places = centers + place, place + 0.2 * torch.randn(50, 3).double()
    found, shifts = (
        compute_gauge_modes(centers, place),
        compute_projection_jacobian(centers, torch.full((5,), 90.0).double(), places),
    )
    axes = torch.eye(3).double().expand(50, 3, 3)
    rotations = torch.linalg.cross(axes, (places - place)[:, :, None].expand(50, 3, 3), dim=1)
    content = torch.cat([axes, rotations, (places - place)[:, :, None], axes], dim=2)
    follows = (
        compute_projection_jacobian(centers, torch.full((5,), 90.0).double(), places)[..., 3:] @ -content
    )  # as a move of the camera, turned
    left = (shifts @ found[:, None] + follows).square().mean((1, 2)).sqrt() / follows.square().mean((1, 2)).sqrt()
    torch.testing.assert_close(left[:, :7], torch.zeros(5, 7).double(), atol=1e-9, rtol=0)
    assert (left[:, 7:] < 0.2).all(), "far cameras see hardly more than a shift"


def test_preconditioner_unit_motion_shifts_points_by_one_pixel():
    centers, places = 3 * torch.nn.functional.normalize(torch.randn(5, 3).double(), dim=1), torch.rand(500, 3).double()
    shifts = compute_projection_jacobian(centers, torch.full((5,), 200.0).double(), places - 0.5)
    free, damped = (
        (shifts @ compute_preconditioner(shifts, damping)[:, None]).square().sum(2).mean(1).sqrt()
        for damping in (1e-9, 1.0)
    )
    torch.testing.assert_close(free, torch.ones(5, 6).double(), rtol=1e-3, atol=0)
    assert (damped < 1).all() and (damped > 0.01).all()
