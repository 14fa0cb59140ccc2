"""Image metrics: PSNR and SSIM."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

PSNR_CHUNK_PIXELS = 1 << 18
"""Pixels per chunk: a large image in float64 would take gigabytes."""


def mse_to_psnr(mse: float) -> float:
    """PSNR in dB, 10 log10(1 / MSE), at most 120."""
    return -10 * math.log10(max(mse, 1e-12))


def psnr(
    image: Float[Tensor, "*shape C"], truth: Float[Tensor, "*shape C"], known: Bool[Tensor, "*shape"] | None = None
) -> float:
    """PSNR in dB of images in [0, 1], over all or the known pixels; nan if none is known."""
    first, second = (x.reshape(-1, x.shape[-1]).cpu().split(PSNR_CHUNK_PIXELS) for x in (image, truth))
    masks = [...] * len(first) if known is None else known.reshape(-1).cpu().split(PSNR_CHUNK_PIXELS)
    squared_errors = count = 0.0
    for a, b, mask in zip(first, second, masks, strict=True):
        errors = (a[mask].double() - b[mask].double()) ** 2
        squared_errors, count = squared_errors + float(errors.sum()), count + errors.numel()
    return mse_to_psnr(squared_errors / count) if count and not math.isnan(squared_errors) else math.nan


SSIM_WINDOW = 11
"""Side of the window in pixels: torchmetrics' default for a Gaussian of 1.5 pixels."""
SSIM_CHUNK_ROWS = 32
"""Rows per chunk: torchmetrics needs a kilobyte per pixel."""


def ssim(
    image: Float[Tensor, "H W 3"],
    truth: Float[Tensor, "H W 3"],
    known: Bool[Tensor, "H W"] | None = None,
    strip: int | None = None,
) -> float:
    """Structural similarity (Wang et al. 2004) of images in [0, 1]; nan if they are smaller than the window.

    With a mask, the mean over windows around known pixels, in which unknown pixels count as equal.

    Args:
        image, truth: to compare.
        known: pixels that count; None for all.
        strip: rows per strip, each compared as an image of its own; None: one strip.
    """
    height, width, _ = image.shape
    if min(height, width, strip or height) < SSIM_WINDOW:
        return math.nan
    first, second = (x.permute(2, 0, 1)[None] for x in (image, truth))
    margin, chunk_rows, total = SSIM_WINDOW // 2 if strip is None else 0, strip or SSIM_CHUNK_ROWS, 0.0
    valid = torch.ones(height, width, dtype=torch.bool) if known is None else known
    second = torch.where(valid, second, first)
    for start in range(0, height, chunk_rows):
        end = min(start + chunk_rows, height)
        top, bottom = max(0, start - margin), min(height, end + margin)
        a, b = (x[:, :, top:bottom] for x in (first, second))
        _, scores = structural_similarity_index_measure(a, b, data_range=1.0, return_full_image=True)
        total += scores[0, :, start - top : end - top][:, valid[start:end]].double().sum().item()
    return total / (3 * int(valid.sum())) if valid.any() else math.nan
