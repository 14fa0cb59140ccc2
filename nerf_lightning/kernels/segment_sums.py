"""Sums along rays that stay exact over many rays, even on devices without double precision."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

DEVICES_WITHOUT_FLOAT64 = ("mps",)
"""Device types without double precision."""
COARSE_UNIT = 2.0**-8
"""Unit of the coarse part of a value: 2^24 of them are exact in single precision."""


def exclusive_sum(
    values: Float[Tensor, "N *D"], ray: Int[Tensor, "N"], offsets: Int[Tensor, "R_plus_1"]
) -> Float[Tensor, "N *D"]:
    """For each sample, the sum of the values before it on its ray.

    Args:
        values, ray: of each sample.
        offsets: first sample of each ray, then N.
    """
    first = offsets.index_select(0, ray)

    def along_ray(total: Tensor, own: Tensor) -> Tensor:
        """From running sums over all rays, which outgrow single precision."""
        less = total - own
        return less - less.index_select(0, first)

    if values.device.type not in DEVICES_WITHOUT_FLOAT64:
        return along_ray(values.cumsum(0, dtype=torch.float64), values).to(values.dtype)
    # Sums of multiples of 2^-8 are exact up to 65536; the remainders are so small that their sums are nearly exact.
    coarse = (values.detach() / COARSE_UNIT).round() * COARSE_UNIT
    fine = values - coarse
    return along_ray(coarse.cumsum(0), coarse) + along_ray(fine.cumsum(0), fine)
