"""Real spherical harmonics: the directions a colour network sees."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels.switch import fast


def spherical_harmonics_reference(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """`spherical_harmonics` in plain torch, for every device and precision."""
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


def spherical_harmonics(d: Float[Tensor, "N 3"]) -> Float[Tensor, "N 16"]:
    """Real spherical harmonics of degrees 0 to 3 at unit directions (orthonormal; Sloan 2013, appendix A2)."""
    if not fast(d) or d.requires_grad:
        return spherical_harmonics_reference(d)
    from nerf_lightning.kernels.cpu import harmonics, workers

    out = torch.empty(16, len(d))
    harmonics.evaluate(d.contiguous().numpy(), out.numpy(), workers())
    return out.T
