"""LPIPS (Zhang et al. 2018), if torchvision and its weights are on this machine already: nothing is ever downloaded."""

import importlib
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import learned_perceptual_image_patch_similarity

WEIGHTS = "alexnet-owt-7be5be79.pth"
"""AlexNet's, as torchvision names them in torch.hub's folder."""
SMALLEST = 64
"""Pixels along a side that AlexNet needs."""

TOO_SMALL = f"photos of less than {SMALLEST} pixels"

Distance = Callable[[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]], float | None]


def perceptual_distance() -> tuple[Distance | None, str]:
    """LPIPS with AlexNet of two pictures in [0, 1]: 0 for the same, smaller is better; None for pictures that are too small.

    Returns:
        It, or None and the reason why it cannot be computed.
    """
    try:
        importlib.import_module("torchvision")
    except ImportError:
        return None, "torchvision is not installed: pip install 'nerf_lightning[lpips]'"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / WEIGHTS
    if not weights.exists():
        return None, f"{weights} is not there"

    def distance(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> float | None:
        if min(image.shape[:2]) < SMALLEST:
            return None
        first, second = (one.permute(2, 0, 1)[None] for one in (image, truth))
        return float(learned_perceptual_image_patch_similarity(first, second, net_type="alex", normalize=True))

    return distance, ""
