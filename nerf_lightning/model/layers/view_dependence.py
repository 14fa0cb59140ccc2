"""How finely a colour may depend on the viewing direction."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import spherical_harmonics


def num_sh_bases(degree: int) -> int:
    """Number of spherical harmonics up to a degree, including the constant one."""
    return (degree + 1) ** 2


def encode_directions(directions: Float[Tensor, "N 3"], count: int) -> Float[Tensor, "N count"]:
    """The first `count` spherical harmonics of unit directions."""
    return spherical_harmonics(directions)[:, :count]
