"""Which way is up, from how the cameras were held."""

import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

LEVEL, TINY = 2.0, 1e-6
"""Weight of the mean up direction of all photos: a multiple of how far from level they were held, and the least. It decides
where all cameras look the same way."""
CLEARLY = 0.1
"""By how much the photos' rows must be less flat (see `flatness`) than their columns for them to lie on their side."""


def image_axes(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "V 4 3"]:
    """The four directions that may be up in each photo: its top, right, bottom and left, world frame."""
    right, down = c2w[:, :3, 0], c2w[:, :3, 1]
    return torch.stack([-down, right, down, -right], dim=1)


def flatness(axes: Float[Tensor, "V 3"]) -> float:
    """How surely unit vectors point everywhere in one plane, from 0 (all along one line, or in all directions) to 0.5."""
    smallest, middle, _ = torch.linalg.eigvalsh(axes.mT @ axes / len(axes)).tolist()
    return middle - smallest


def held(c2w: Float[Tensor, "V 4 4"]) -> tuple[Float[Tensor, "3"], Int[Tensor, "V"]]:
    """Up, and which side of each photo is its top.

    Photos are taken level, upright or on their side. All around a subject, their level axes point everywhere in one plane;
    up is perpendicular to it.

    Returns:
        Unit vector, world frame; 0 to 3 for a photo whose top, right, bottom or left side is up.
    """
    axes = image_axes(c2w.double())
    sideways = flatness(axes[:, 0]) > flatness(axes[:, 1]) + CLEARLY
    up = torch.nn.functional.normalize(axes[:, 1 if sideways else 0].mean(0), dim=0)
    slope = float((c2w[:, :3, 2].double() @ up).mean())
    # Which side of a photo that lies on its side is up it does not tell; people look down at what they photograph.
    if sideways and slope > 0:
        up = -up
    for _ in range(3):
        side = (axes @ up).argmax(1)
        pick = torch.arange(len(axes), device=axes.device)
        mean = torch.nn.functional.normalize(axes[pick, side].mean(0), dim=0)
        level = axes[pick, (side + 1) % 4]
        eye = torch.eye(3, dtype=axes.dtype, device=axes.device)
        spread = level.mT @ level / len(level)
        weight = LEVEL * torch.linalg.eigvalsh(spread)[0].clamp_min(0) + TINY
        found = torch.linalg.eigh(spread + weight * (eye - mean[:, None] * mean)).eigenvectors[:, 0]
        up = found if float(found @ mean) >= 0 else -found
    return up.to(c2w.dtype), side


def turn_upright(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes `up`, a unit vector, to (0, 0, 1)."""
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], up[None].double().cpu().numpy())
    return torch.from_numpy(turn.as_matrix()).to(up)
