"""Small motions of cameras: what they do to rays, and to where places appear in the photos."""

import torch
from jaxtyping import Float
from torch import Tensor

DISTANCE_DAMPING = 1e-3
"""Share of the mean squared distance that is added to all, for cameras in the middle of the content."""
RANK_TOLERANCE = 1e-6
"""Vectors whose own part is smaller than this, as a share of their length, are made of others."""
TAYLOR_MAX_ANGLE_SQUARED = 1e-6
"""Squared angle below which a series stands in for the factors of a turn, so that gradients exist at 0 too."""


def rotate_axis_angle(vectors: Float[Tensor, "R 3"], rotations: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Vectors, each rotate about an axis (Rodrigues' formula).

    Args:
        vectors: of any length.
        rotations: the axes' directions, as long as the angles are in radians.
    """
    square = rotations.square().sum(1, keepdim=True)
    small = square < TAYLOR_MAX_ANGLE_SQUARED
    angle = torch.where(small, 1.0, square).sqrt()
    first = torch.where(small, 1 - square / 6, angle.sin() / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / angle.square())
    perpendicular = torch.linalg.cross(rotations, vectors, dim=1)
    return vectors + first * perpendicular + second * torch.linalg.cross(rotations, perpendicular, dim=1)


def compute_projection_jacobian(
    centres: Float[Tensor, "V 3"], focals: Float[Tensor, "V"], points: Float[Tensor, "P 3"]
) -> Float[Tensor, "V P 3 6"]:
    """How far places move in each photo, per unit of a small turn and a small move of its camera.

    Args:
        centres: of the cameras, world frame.
        focals: in pixels.
        points: world frame.

    Returns:
        Derivatives of the direction from the camera, in pixels at the photo's centre, as vectors of the camera's frame written
        along world axes. The first three columns are of a turn about the camera's centre (world axes, radians), the last three
        of a move of it (world units).
    """
    offsets = points - centres[:, None]
    distance = offsets.norm(dim=2)[..., None, None]
    ray = offsets[..., None] / distance
    axes = torch.eye(3, dtype=ray.dtype, device=ray.device).expand(*ray.shape[:2], 3, 3)
    # Seen from a camera that turns by w and moves by m, a place at p moves by p x w - m.
    rotation = torch.linalg.cross(offsets[:, :, None].expand_as(axes), axes, dim=3).mT
    return focals[:, None, None, None] * (axes - ray * ray.mT) @ torch.cat([rotation, -axes], dim=3) / distance


def compute_gauge_modes(centres: Float[Tensor, "V 3"], content_centre: Float[Tensor, "3"]) -> Float[Tensor, "V 6 10"]:
    """Motions of all cameras together that photos do not tell, or hardly: of cameras and content as a whole, and of the content
    alone, which far cameras follow by turning.

    Args:
        centres: of the cameras, world frame.
        content_centre: the middle of the content, world frame.

    Returns:
        Per camera a turn and a move as in `compute_projection_jacobian`; columns: three shifts, three turns and the growth of
        everything, and for three shifts of the content.
    """
    axes = torch.eye(3, dtype=centres.dtype, device=centres.device).expand(len(centres), 3, 3)
    zeros, offsets = torch.zeros_like(axes), (centres - content_centre)[:, :, None]
    square = offsets.square().sum(1, keepdim=True)
    square = (square + DISTANCE_DAMPING * square.mean()).clamp_min(torch.finfo(square.dtype).tiny)
    perpendicular = torch.linalg.cross(axes, offsets.expand_as(axes), dim=1)
    rotations = torch.cat([zeros, axes, zeros[..., :1], perpendicular / square], dim=2)
    translations = torch.cat([axes, perpendicular, offsets, zeros], dim=2)
    return torch.cat([rotations, translations], dim=1)


def compute_preconditioner(jacobian: Float[Tensor, "V P 3 6"], damping: float) -> Float[Tensor, "V 6 6"]:
    """For each photo the matrix that turns a vector of unit length into a motion that shifts places by about a pixel.

    The inverse square root of the mean of J^T J, damped: Park et al. 2023, "CamP", section 4.

    Args:
        jacobian: J, see `compute_projection_jacobian`.
        damping: share of each motion's own effect that is added, so that motions which hardly show do not grow without limit.
    """
    square = (jacobian.mT @ jacobian).mean(1)
    square = square + damping * torch.diag_embed(square.diagonal(dim1=1, dim2=2))
    values, vectors = torch.linalg.eigh(square)
    return vectors @ torch.diag_embed(values.rsqrt()) @ vectors.mT


def orthonormal_basis(vectors: Float[Tensor, "N K"]) -> Float[Tensor, "N B"]:
    """An orthonormal basis of what some columns span."""
    lengths = vectors.norm(dim=0).clamp_min(torch.finfo(vectors.dtype).tiny)
    basis, sizes, _ = torch.linalg.svd(vectors / lengths, full_matrices=False)
    return basis[:, sizes > RANK_TOLERANCE]


def project_out(vectors: Float[Tensor, "V K"], basis: Float[Tensor, "VK B"]) -> Float[Tensor, "V K"]:
    """What is left of vectors, taken as one long one, off an orthonormal basis."""
    return vectors - (basis * (basis * vectors.flatten()[:, None]).sum(0)).sum(1).view_as(vectors)
