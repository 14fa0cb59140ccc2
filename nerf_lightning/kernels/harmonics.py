"""Real spherical harmonics: the directions a colour network sees."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.constants import constant
from nerf_lightning.kernels.switch import has_fast

TERMS: tuple[dict[str, float], ...] = (
    {"111": 0.28209479177387814},
    {"11y": -0.48860251190291987},
    {"11z": 0.48860251190291987},
    {"11x": -0.48860251190291987},
    {"1xy": 1.0925484305920792},
    {"1yz": -1.0925484305920792},
    {"1zz": 3 * 0.31539156525252005, "111": -0.31539156525252005},
    {"1xz": -1.0925484305920792},
    {"1xx": 0.5462742152960396, "1yy": -0.5462742152960396},
    {"xxy": -3 * 0.5900435899266435, "yyy": 0.5900435899266435},
    {"xyz": 2.890611442640554},
    {"yzz": -5 * 0.4570457994644657, "11y": 0.4570457994644657},
    {"zzz": 5 * 0.3731763325901154, "11z": -3 * 0.3731763325901154},
    {"xzz": -5 * 0.4570457994644657, "11x": 0.4570457994644657},
    {"xxz": 1.445305721320277, "yyz": -1.445305721320277},
    {"xxx": -0.5900435899266435, "xyy": 3 * 0.5900435899266435},
)
"""Each function as factors of products of three out of 1, x, y and z."""


@constant
def _factors(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "64 16"]:
    """What each function takes of all those products."""
    table = torch.zeros(4, 4, 4, len(TERMS), dtype=dtype)
    for number, terms in enumerate(TERMS):
        for product, factor in terms.items():
            i, j, k = ("1xyz".index(letter) for letter in product)
            table[i, j, k, number] = factor
    return table.flatten(0, 2).to(device)


def spherical_harmonics_reference(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """`spherical_harmonics` in plain PyTorch, for every device and precision, as one matrix product."""
    one = pad(d, (1, 0), value=1.0)
    three = one[:, :, None, None] * one[:, None, :, None] * one[:, None, None, :]
    return three.flatten(1) @ _factors(d.dtype, d.device)


def spherical_harmonics(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """Real spherical harmonics of degrees 0 to 3 at unit directions (orthonormal; Sloan 2013, appendix A2)."""
    if not has_fast(constants=(d,)):
        return spherical_harmonics_reference(d)
    out = torch.empty(16, len(d))
    cpu.harmonics.evaluate(d, out)
    return out.T
