"""Camera motions: axis-angle rotation, projection Jacobian, gauge modes, and preconditioner of pose refinement."""

import torch
from jaxtyping import Float
from torch import Tensor

DISTANCE_DAMPING = 1e-3
"""Fraction of the mean squared distance that is added to each, for cameras at the center of the content."""
RANK_TOLERANCE = 1e-6
"""Relative singular value below which a direction counts as linearly dependent."""
TAYLOR_MAX_ANGLE_SQUARED = 1e-6
"""Squared angle below which Rodrigues' factors are Taylor series, so that gradients exist at 0."""


def rotate_axis_angle(vectors: Float[Tensor, "R 3"], rotations: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Rotates each vector about its axis (Rodrigues' formula).

    Args:
        vectors: of any length.
        rotations: unit axis times angle in radians.
    """
    square = rotations.square().sum(1, keepdim=True)
    small = square < TAYLOR_MAX_ANGLE_SQUARED
    angle = torch.where(small, 1.0, square).sqrt()
    first = torch.where(small, 1 - square / 6, angle.sin() / angle)
    second = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / angle.square())
    perpendicular = torch.linalg.cross(rotations, vectors, dim=1)
    return vectors + first * perpendicular + second * torch.linalg.cross(rotations, perpendicular, dim=1)


def compute_projection_jacobian(
    centers: Float[Tensor, "V 3"], focals: Float[Tensor, "V"], points: Float[Tensor, "P 3"]
) -> Float[Tensor, "V P 3 6"]:
    """Jacobian of the points' projections in the rotation and translation of each camera.

    Args:
        centers: of the cameras, world frame.
        focals: in pixels.
        points: world frame.

    Returns:
        Derivatives of the direction from the camera, in pixels at the image center, along world axes. Columns 0 to 2: rotation
        about the camera center (world axes, radians); 3 to 5: its translation (world units).
    """
    offsets = points - centers[:, None]
    distance = offsets.norm(dim=2)[..., None, None]
    ray = offsets[..., None] / distance
    axes = torch.eye(3, dtype=ray.dtype, device=ray.device).expand(*ray.shape[:2], 3, 3)
    # Seen from a camera that rotates by w and translates by m, a point p moves by p x w - m.
    rotation = torch.linalg.cross(offsets[:, :, None].expand_as(axes), axes, dim=3).mT
    return focals[:, None, None, None] * (axes - ray * ray.mT) @ torch.cat([rotation, -axes], dim=3) / distance


def compute_gauge_modes(centers: Float[Tensor, "V 3"], content_center: Float[Tensor, "3"]) -> Float[Tensor, "V 6 10"]:
    """Gauge modes: joint camera motions that photos cannot, or hardly, constrain.

    The 7-DoF similarity, and translations of the content, which distant cameras absorb by rotating.

    Args:
        centers: of the cameras, world frame.
        content_center: world frame.

    Returns:
        Rotation and translation of each camera as in `compute_projection_jacobian`. Columns: translation (3), rotation (3) and
        scale (1) of everything, translation of the content (3).
    """
    axes = torch.eye(3, dtype=centers.dtype, device=centers.device).expand(len(centers), 3, 3)
    zeros, offsets = torch.zeros_like(axes), (centers - content_center)[:, :, None]
    square = offsets.square().sum(1, keepdim=True)
    square = (square + DISTANCE_DAMPING * square.mean()).clamp_min(torch.finfo(square.dtype).tiny)
    perpendicular = torch.linalg.cross(axes, offsets.expand_as(axes), dim=1)
    rotations = torch.cat([zeros, axes, zeros[..., :1], perpendicular / square], dim=2)
    translations = torch.cat([axes, perpendicular, offsets, zeros], dim=2)
    return torch.cat([rotations, translations], dim=1)


def compute_preconditioner(jacobian: Float[Tensor, "V P 3 6"], damping: float) -> Float[Tensor, "V 6 6"]:
    """Preconditioner of each photo: maps unit vectors to motions that shift points by about a pixel.

    The inverse square root of the damped mean of J^T J: Park et al. 2023, "CamP", section 4.

    Args:
        jacobian: J, see `compute_projection_jacobian`.
        damping: relative to the diagonal; bounds motions that hardly show.
    """
    square = (jacobian.mT @ jacobian).mean(1)
    square = square + damping * torch.diag_embed(square.diagonal(dim1=1, dim2=2))
    values, vectors = torch.linalg.eigh(square)
    return vectors @ torch.diag_embed(values.rsqrt()) @ vectors.mT


def orthonormal_basis(vectors: Float[Tensor, "N K"]) -> Float[Tensor, "N B"]:
    """Orthonormal basis of the column space."""
    lengths = vectors.norm(dim=0).clamp_min(torch.finfo(vectors.dtype).tiny)
    basis, sizes, _ = torch.linalg.svd(vectors / lengths, full_matrices=False)
    return basis[:, sizes > RANK_TOLERANCE]


def project_out(vectors: Float[Tensor, "V K"], basis: Float[Tensor, "VK B"]) -> Float[Tensor, "V K"]:
    """Removes from the flattened vectors their component in the span of an orthonormal basis."""
    return vectors - (basis * (basis * vectors.flatten()[:, None]).sum(0)).sum(1).view_as(vectors)
