"""Photometric loss of rendered rays."""

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerf_lightning.kernels import gpu
from nerf_lightning.kernels.backend import has_gpu_kernel


def composite_over(pixels: UInt8[Tensor, "R C"], backgrounds: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Composites photo pixels with straight alpha (C = 4) onto backgrounds; returns RGB in [0, 1]."""
    colors = (pixels / 255).to(backgrounds.dtype)
    if colors.shape[1] == 3:
        return colors
    return torch.lerp(backgrounds, colors[:, :3], colors[:, 3:])


def mean_squared_error(
    rgb: Tensor, truth: Tensor, weights: Tensor | None, complete: Tensor | None
) -> tuple[Float[Tensor, ""], Float[Tensor, "R"]]:
    """`photometric_loss` of composited colors [R, 3]."""
    if complete is not None:  # truncated rays must not contribute
        rgb = torch.where(complete[:, None], rgb, truth)
    squared_errors = (rgb - truth).square().mean(1)
    return (squared_errors if weights is None else squared_errors * weights).mean(), squared_errors


def photometric_loss(
    foreground: Float[Tensor, "R 3"],
    opacity: Float[Tensor, "R"],
    backgrounds: Float[Tensor, "R 3"],
    pixels: UInt8[Tensor, "R C"],
    weights: Float[Tensor, "R"] | None = None,
    complete: Bool[Tensor, "R"] | None = None,
) -> tuple[Float[Tensor, ""], Float[Tensor, "R"]]:
    """Weighted mean of the squared errors of rendered rays against photo pixels, and each ray's (the mean of its channels).

    Args:
        foreground, opacity: color without background, and opacity.
        pixels: see `composite_over`.
        weights: weight of each ray.
        complete: rays that have all their samples; the others have no error.
    """
    constants = (backgrounds,) if weights is None else (backgrounds, weights)
    if has_gpu_kernel(foreground, opacity, constants=constants):
        return gpu.composite.PhotometricLoss.apply(foreground, opacity, backgrounds, pixels, weights, complete)
    rgb = torch.addcmul(foreground, (1 - opacity)[:, None], backgrounds)
    return mean_squared_error(rgb, composite_over(pixels, backgrounds), weights, complete)
