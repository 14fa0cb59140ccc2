"""Photometric loss of rendered rays."""

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerf_lightning.kernels import gpu
from nerf_lightning.kernels.backend import has_gpu_kernel

PhotometricLosses = tuple[Float[Tensor, ""], Float[Tensor, ""] | None, Float[Tensor, "R"]]
"""Weighted mean squared error of the colors, that of the opacity, and each ray's sum of both without its weight."""


def composite_over(pixels: UInt8[Tensor, "R C"], backgrounds: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
    """Composites photo pixels with straight alpha (C = 4) onto backgrounds; returns RGB in [0, 1]."""
    colors = (pixels / 255).to(backgrounds.dtype)
    if colors.shape[1] == 3:
        return colors
    return torch.lerp(backgrounds, colors[:, :3], colors[:, 3:])


def _mean_squared_error(
    x: Tensor, truth: Tensor, weights: Tensor | None, complete: Tensor | None
) -> tuple[Float[Tensor, ""], Float[Tensor, "R"]]:
    if complete is not None:  # truncated rays must not contribute
        x = torch.where(complete[:, None], x, truth)
    squared_errors = (x - truth).square().mean(1)
    return (squared_errors if weights is None else squared_errors * weights).mean(), squared_errors


def compare_colors(
    rgb: Tensor, truth: Tensor, opacity: Tensor, pixels: Tensor, weights: Tensor | None, complete: Tensor | None,
    variance: float,
) -> PhotometricLosses:  # fmt: skip
    """`photometric_loss` of composited colors [R, 3] in plain PyTorch, for every device.

    A channel's error on a background b is e + (alpha - opacity) * (b - mean): its expected square adds the variance of b times
    the squared error of the opacity. This mean over all colors has less noise than one color per ray.
    """
    loss, squared_errors = _mean_squared_error(rgb, truth, weights, complete)
    if not variance:
        return loss, None, squared_errors
    on_opacity, opacity_errors = _mean_squared_error(opacity[:, None], pixels[:, 3:] / 255, weights, complete)
    return loss, variance * on_opacity, squared_errors + variance * opacity_errors


def photometric_loss(
    foreground: Float[Tensor, "R 3"],
    opacity: Float[Tensor, "R"],
    backgrounds: Float[Tensor, "R 3"],
    pixels: UInt8[Tensor, "R C"],
    weights: Float[Tensor, "R"] | None = None,
    complete: Bool[Tensor, "R"] | None = None,
    variance: float = 0.0,
) -> PhotometricLosses:
    """Compares rendered rays with photo pixels.

    Args:
        foreground, opacity: color without background, and opacity.
        pixels: see `composite_over`.
        weights: weight of each ray.
        complete: rays that have all their samples; the others have no error.
        variance: of the backgrounds' channels, where they are random with mean `backgrounds`; 0: no error of the opacity.
    """
    constants = (backgrounds,) if weights is None else (backgrounds, weights)
    if has_gpu_kernel(foreground, opacity, constants=constants):
        arguments = foreground, opacity, backgrounds, pixels, weights, complete, variance
        loss, on_opacity, squared_errors = gpu.composite.PhotometricLoss.apply(*arguments)
        return loss, on_opacity if variance else None, squared_errors
    rgb, truth = torch.addcmul(foreground, (1 - opacity)[:, None], backgrounds), composite_over(pixels, backgrounds)
    return compare_colors(rgb, truth, opacity, pixels, weights, complete, variance)
