"""Exclusive sums along rays, exact over many rays even without float64."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

DEVICES_WITHOUT_FLOAT64 = ("mps",)
"""Device types without float64."""
COARSE_UNIT = 2.0**-8
"""Unit of the coarse part of a value: multiples up to 2^24 are exact in float32."""


def exclusive_sum(
    values: Float[Tensor, "N *D"], ray: Int[Tensor, "N"], offsets: Int[Tensor, "R_plus_1"]
) -> Float[Tensor, "N *D"]:
    """Sum of the preceding values on the ray, for each sample.

    Args:
        values, ray: value and ray of each sample.
        offsets: first sample of each ray, then N.
    """
    first = offsets.index_select(0, ray)

    def along_ray(total: Tensor, terms: Tensor) -> Tensor:
        """Converts cumulative sums over all rays, which need more than float32."""
        exclusive = total - terms
        return exclusive - exclusive.index_select(0, first)

    if values.device.type not in DEVICES_WITHOUT_FLOAT64:
        return along_ray(values.cumsum(0, dtype=torch.float64), values).to(values.dtype)
    # Sums of multiples of 2^-8 are exact up to 65536; sums of the small remainders are nearly exact.
    coarse = (values.detach() / COARSE_UNIT).round() * COARSE_UNIT
    fine = values - coarse
    return along_ray(coarse.cumsum(0), coarse) + along_ray(fine.cumsum(0), fine)
