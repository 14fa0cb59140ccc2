"""Fixed encodings of positions and directions."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import spherical_harmonics
from nerf_lightning.kernels.cached_constants import cache_constants


def sinusoidal(x: Float[Tensor, "*batch D"], frequencies: int) -> Float[Tensor, "*batch E"]:
    """[x, sin(2^0 pi x), cos(2^0 pi x), ..., sin(2^(L-1) pi x), cos(2^(L-1) pi x)], E = D (1 + 2 L)  (NeRF, eq. 4)."""
    angles = x[..., None, :] * _octaves(frequencies, x.dtype, x.device)
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], dim=-2)
    return torch.cat([x, waves.flatten(-3)], dim=-1)


@cache_constants
def _octaves(frequencies: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "L 1"]:
    return math.pi * 2.0 ** torch.arange(frequencies, device=device, dtype=dtype)[:, None]


def num_sh_bases(degree: int) -> int:
    """Number of spherical harmonics of degrees 0 to `degree`."""
    return (degree + 1) ** 2


def encode_directions(directions: Float[Tensor, "N 3"], count: int) -> Float[Tensor, "N count"]:
    """The first `count` spherical harmonics of unit directions."""
    return spherical_harmonics(directions)[:, :count]
