"""How good a picture is."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure


def mse_to_psnr(mse: float) -> float:
    """10 log10(1 / MSE), at most 120 dB."""
    return -10 * math.log10(max(mse, 1e-12))


def psnr(image: Float[Tensor, "*shape"], truth: Float[Tensor, "*shape"]) -> float:
    """Peak signal-to-noise ratio in dB, 10 log10(1 / MSE), of pictures in [0, 1]."""
    first, second = (x.cpu().double() for x in (image, truth))  # not every device has doubles
    return mse_to_psnr(float(torch.mean((first - second) ** 2)))


SSIM_WINDOW = 11
"""Pixels along a side of the window that torchmetrics uses with its default Gaussian of 1.5 pixels."""
SSIM_ROWS = 32
"""Rows compared at once: the library needs a kilobyte for each pixel."""


def ssim(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> float:
    """Structural similarity (Wang et al. 2004) of pictures in [0, 1]; nan if they are smaller than its window."""
    height, width, _ = image.shape
    if min(height, width) < SSIM_WINDOW:
        return math.nan
    first, second = (x.permute(2, 0, 1)[None] for x in (image, truth))
    margin, total = SSIM_WINDOW // 2, 0.0
    for start in range(0, height, SSIM_ROWS):
        end = min(start + SSIM_ROWS, height)
        top, bottom = max(0, start - margin), min(height, end + margin)
        _, scores = structural_similarity_index_measure(
            first[:, :, top:bottom], second[:, :, top:bottom], data_range=1.0, return_full_image=True
        )
        total += scores[:, :, start - top : end - top].double().sum().item()
    return total / image.numel()
