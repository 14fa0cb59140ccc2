"""Real spherical harmonics, the directional encoding."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.backend import has_fast_kernel
from nerf_lightning.kernels.cached_constants import cache_constants

_X, _Y, _Z, _ONE = (1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0)
_R3, _R5 = 3**0.5, 5**0.5
_PLUS, _MINUS = (1.0, 1, 0, 0), (1.0, -1, 0, 0)
_Z2, _Z3 = ((0, 0, _R5, -1.0), (0, 0, _R5, 1.0)), ((0, 0, _R5, -_R3), (0, 0, _R5, _R3))
# On the unit sphere each function is a coefficient times three linear factors of (x, y, z, 1).
LINEAR_FACTORS = (
    (0.28209479177387814, _ONE, _ONE, _ONE),
    (-0.48860251190291987, _Y, _ONE, _ONE),
    (0.48860251190291987, _Z, _ONE, _ONE),
    (-0.48860251190291987, _X, _ONE, _ONE),
    (1.0925484305920792, _X, _Y, _ONE),
    (-1.0925484305920792, _Y, _Z, _ONE),
    (0.31539156525252005, (0, 0, _R3, -1.0), (0, 0, _R3, 1.0), _ONE),
    (-1.0925484305920792, _X, _Z, _ONE),
    (0.5462742152960396, _PLUS, _MINUS, _ONE),
    (-0.5900435899266435, _Y, (_R3, -1.0, 0, 0), (_R3, 1.0, 0, 0)),
    (2.890611442640554, _X, _Y, _Z),
    (-0.4570457994644657, _Y, *_Z2),
    (0.3731763325901154, _Z, *_Z3),
    (-0.4570457994644657, _X, *_Z2),
    (1.445305721320277, _Z, _PLUS, _MINUS),
    (-0.5900435899266435, _X, (1.0, -_R3, 0, 0), (1.0, _R3, 0, 0)),
)


@cache_constants
def _factors(dtype: torch.dtype, device: torch.device) -> tuple[Float[Tensor, "48"], Float[Tensor, "3 48"]]:
    """Constants and matrix of all factors, those of a place in the product one after the other."""
    scaled = [[c * first for first in first_factor] for c, first_factor, _, _ in LINEAR_FACTORS]
    rows = [*scaled, *(row[place] for place in (2, 3) for row in LINEAR_FACTORS)]
    matrix = torch.tensor(rows, dtype=dtype, device=device)
    return matrix[:, 3].contiguous(), matrix[:, :3].T.contiguous()


def spherical_harmonics_reference(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """`spherical_harmonics` in plain PyTorch, for every device and precision, in two operations."""
    constants, matrix = _factors(d.dtype, d.device)
    return torch.addmm(constants, d, matrix).view(len(d), 3, 16).prod(1)


def spherical_harmonics(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """Real spherical harmonics of degrees 0 to 3 at unit directions (orthonormal; Sloan 2013, appendix A2)."""
    if not has_fast_kernel(constants=(d,)):
        return spherical_harmonics_reference(d)
    out = torch.empty(16, len(d))
    cpu.harmonics.evaluate(d, out)
    return out.T
