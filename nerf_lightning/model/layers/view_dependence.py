"""How finely a colour may depend on the viewing direction."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.errors import InputError
from nerf_lightning.kernels import spherical_harmonics

HIGHEST = 3
"""The highest degree of spherical harmonics available."""


def harmonics_up_to(degree: int) -> int:
    """Number of spherical harmonics up to a degree, including the constant one.

    Raises:
        InputError: outside 0 to 3.
    """
    if not 0 <= degree <= HIGHEST:
        raise InputError("model.degree", "", str(degree), f"0 to {HIGHEST}")
    return (degree + 1) ** 2


def seen_from(directions: Float[Tensor, "N 3"], terms: int) -> Float[Tensor, "N terms"]:
    """The first `terms` spherical harmonics of unit directions."""
    return spherical_harmonics(directions)[:, :terms]
