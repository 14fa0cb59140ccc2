"""How good a picture is."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure


def psnr(image: Float[Tensor, "*shape"], truth: Float[Tensor, "*shape"]) -> float:
    """Peak signal-to-noise ratio in dB, 10 log10(1 / MSE), of pictures in [0, 1]."""
    mse = float(torch.mean((image.double() - truth.double()) ** 2))
    return -10 * math.log10(max(mse, 1e-12))


def ssim(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> float:
    """Structural similarity (Wang et al. 2004) of pictures in [0, 1]; nan where they are smaller than its 11-pixel window."""
    if min(image.shape[:2]) < 11:
        return math.nan
    first, second = (x.permute(2, 0, 1)[None] for x in (image, truth))
    score = structural_similarity_index_measure(first, second, data_range=1.0)
    assert isinstance(score, Tensor)  # a pair only where its options ask for one
    return score.item()
