"""Real spherical harmonics, the directional encoding."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.backend import has_fast_kernel
from nerf_lightning.kernels.cached_constants import cache_constants

# Monomials of degree 2 and 3 in the harmonics, as indices of their factors.
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
TRIPLES = tuple((pair, axis) for pair in (0, 1, 2) for axis in (0, 1, 2)) + ((3, 2),)
_XX, _YY, _ZZ, _XY, _YZ, _XZ = range(3, 9)


def _cubic(pair: int, axis: int) -> int:
    return 9 + TRIPLES.index((pair - 3, axis))


# Coefficients of the monomials in each function; the first function is constant.
TERMS: tuple[dict[int, float], ...] = (
    {},
    {1: -0.48860251190291987},
    {2: 0.48860251190291987},
    {0: -0.48860251190291987},
    {_XY: 1.0925484305920792},
    {_YZ: -1.0925484305920792},
    {_ZZ: 3 * 0.31539156525252005},
    {_XZ: -1.0925484305920792},
    {_XX: 0.5462742152960396, _YY: -0.5462742152960396},
    {_cubic(_XX, 1): -3 * 0.5900435899266435, _cubic(_YY, 1): 0.5900435899266435},
    {_cubic(_XY, 2): 2.890611442640554},
    {_cubic(_ZZ, 1): -5 * 0.4570457994644657, 1: 0.4570457994644657},
    {_cubic(_ZZ, 2): 5 * 0.3731763325901154, 2: -3 * 0.3731763325901154},
    {_cubic(_ZZ, 0): -5 * 0.4570457994644657, 0: 0.4570457994644657},
    {_cubic(_XX, 2): 1.445305721320277, _cubic(_YY, 2): -1.445305721320277},
    {_cubic(_XX, 0): -0.5900435899266435, _cubic(_YY, 0): 3 * 0.5900435899266435},
)
CONSTANTS = {0: 0.28209479177387814, 6: -0.31539156525252005}


@cache_constants
def _tables(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Coefficients of all monomials, constants, and indices of the factors of pairs and triples."""
    factors = [[terms.get(power, 0.0) for terms in TERMS] for power in range(9 + len(TRIPLES))]
    constants = [CONSTANTS.get(function, 0.0) for function in range(len(TERMS))]
    firsts, seconds, pairs, axes = (list(column) for both in (PAIRS, TRIPLES) for column in zip(*both, strict=True))
    columns = [torch.tensor(column, device=device) for column in (firsts + seconds + axes, pairs)]
    matrix, bias = (torch.tensor(values, dtype=dtype, device=device) for values in (factors, constants))
    return matrix, bias, columns


def spherical_harmonics_reference(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """`spherical_harmonics` in plain PyTorch, for every device and precision, as one matrix product."""
    factors, constants, (coordinates, pair) = _tables(d.dtype, d.device)
    first, second, axis = d.index_select(1, coordinates).split([len(PAIRS), len(PAIRS), len(TRIPLES)], dim=1)
    pairs = first * second
    triples = pairs.index_select(1, pair) * axis
    return torch.addmm(constants, torch.cat([d, pairs, triples], dim=1), factors)


def spherical_harmonics(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """Real spherical harmonics of degrees 0 to 3 at unit directions (orthonormal; Sloan 2013, appendix A2)."""
    if not has_fast_kernel(constants=(d,)):
        return spherical_harmonics_reference(d)
    out = torch.empty(16, len(d))
    cpu.harmonics.evaluate(d, out)
    return out.T
