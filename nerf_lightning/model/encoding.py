"""Fixed encodings of places and directions."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def sinusoidal(x: Float[Tensor, "*batch D"], frequencies: int) -> Float[Tensor, "*batch E"]:
    """[x, sin(2^0 pi x), cos(2^0 pi x), ..., sin(2^(L-1) pi x), cos(2^(L-1) pi x)], E = D (1 + 2 L)  (NeRF, eq. 4)."""
    octaves = math.pi * 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)
    angles = x[..., None, :] * octaves[:, None]
    waves = torch.stack([torch.sin(angles), torch.cos(angles)], dim=-2)
    return torch.cat([x, waves.flatten(-3)], dim=-1)


def spherical_harmonics(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """Real spherical harmonics of degrees 0 to 3 at unit directions (orthonormal; Sloan 2013, appendix A2)."""
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.48860251190291987 * y,
            0.48860251190291987 * z,
            -0.48860251190291987 * x,
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * zz - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644657 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            -0.4570457994644657 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        dim=-1,
    )
