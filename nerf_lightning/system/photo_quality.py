"""Quality of single photos: PSNR of training photos, and of held-out ones with test-time camera alignment."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.dataset import Views
from nerf_lightning.refine import Corrections
from nerf_lightning.system.correction_trial import (
    EXPOSURE,
    POSES,
    PhotoPixels,
    RenderFn,
    compute_residual_jacobian,
    compute_squared_errors,
    freeze_renderer,
    render_photo_pixels,
    sample_photo_pixels,
    solve_damped_least_squares,
)
from nerf_lightning.system.metrics import mse_to_psnr
from nerf_lightning.system.nerf3d import NeRF3D
from nerf_lightning.utils.progress import track_progress
from nerf_lightning.utils.seeding import Stream, step_generator

PIXELS_PER_PHOTO = 256
"""Pixels compared in each training photo."""
MIN_OUTLIER_DEVIATIONS, MIN_OUTLIER_GAP_DB = 7.0, 6.0
"""An outlier is below the median PSNR by this many robust standard deviations and this many dB."""
IMAGE_HALVES = (0.0, 0.5), (0.5, 1.0)
"""Column ranges of a held-out photo: cameras are fitted on one half and scored on the other."""
JOINT_STEPS, PER_CAMERA_STEPS = 4, 6
"""Least-squares steps of all cameras jointly, then of each alone. More would overfit the field's errors."""
ALIGN_PIXELS, MIN_ALIGN_PIXELS = 2048, 256
"""Pixels of each half fitted per step: default, and minimum where time is short."""
SCORED_PIXELS = 1 << 15
"""Pixels scored in each half."""
ALIGN_COST_PIXELS = 2 * ((JOINT_STEPS + PER_CAMERA_STEPS) * ALIGN_PIXELS * 5 + SCORED_PIXELS)
"""Cost of aligning and scoring a photo, in rendered pixels: derivatives cost as much as three."""


def measure_photo_psnr(system: NeRF3D, views: Views) -> list[float]:
    """PSNR in dB of each training photo as corrected, on a sample of its pixels; nan where none is known."""
    views, background = views.to(system.device), system.renderer.background.color
    generator = step_generator(system.seed, Stream.ANALYSIS, 2, system.device)
    pixels = sample_photo_pixels(views, range(len(views)), PIXELS_PER_PHOTO, background, generator)
    squared_errors = compute_photo_errors(lambda rays, _: system.render(rays), system.corrections, pixels, len(views))
    known = pixels.known.view(len(views), -1).sum(1)
    return [mse_to_psnr(mse) for mse in (squared_errors / (3 * known)).tolist()]


def compute_photo_errors(
    render: RenderFn, corrections: Corrections | None, pixels: PhotoPixels, num_photos: int
) -> Float[Tensor, "V"]:
    """Renders pixels and sums their squared errors by photo, see `compute_squared_errors`."""
    return compute_squared_errors(render_photo_pixels(render, corrections, pixels), corrections, pixels, num_photos)


def find_outlier_photos(psnrs: list[float]) -> list[int]:
    """Indices of outlier photos, worst first. The standard deviation is 1.4826 times the median absolute deviation."""
    values = torch.tensor(psnrs, dtype=torch.float64)
    median = values.nanmedian()
    deviation = 1.4826 * (values - median).abs().nanmedian()
    limit = float(median - max(MIN_OUTLIER_GAP_DB, MIN_OUTLIER_DEVIATIONS * float(deviation)))
    return sorted((i for i, value in enumerate(psnrs) if value < limit), key=psnrs.__getitem__)


@torch.inference_mode(False)  # a trainer tests in inference mode
def measure_aligned_psnr(system: NeRF3D, views: Views, fraction: float = 1.0) -> list[float]:
    """PSNR in dB of each held-out photo with test-time camera alignment, as NeRF-W does for appearance.

    Poses and gains are fitted on one half of a photo and scored on the other: refined cameras may differ from held-out ones by
    a global transform, which is no fault of the field.

    Args:
        system: with corrections.
        views: the held-out photos.
        fraction: of `ALIGN_PIXELS` to fit, at least `MIN_ALIGN_PIXELS`, to save time.
    """
    assert system.corrections is not None  # else there is nothing to align
    views, background = views.to(system.device), system.renderer.background.color
    squared_errors, known = torch.zeros(2, len(views), dtype=torch.float64)
    num_pixels = max(MIN_ALIGN_PIXELS, round(fraction * ALIGN_PIXELS))
    for half, other in zip(IMAGE_HALVES, IMAGE_HALVES[::-1], strict=True):
        corrections = system.corrections.make_held_out_corrections(views.cameras, system.sampler.bounds)
        corrections.to(system.device)
        generator = step_generator(system.seed, Stream.ANALYSIS, 1, system.device)
        options: dict[str, Any] = {"background": background, "generator": generator, "column_range": half}
        draw = partial(sample_photo_pixels, views, num_pixels=num_pixels, **options)
        align_cameras(freeze_renderer(system), corrections, draw)
        for view in range(len(views)):
            pixels = sample_photo_pixels(views, [view], SCORED_PIXELS, background, generator, other)
            errors = compute_photo_errors(lambda rays, _: system.render(rays), corrections, pixels, 1)
            squared_errors[view] += float(errors)
            known[view] += 3 * int(pixels.known.sum())
    return [mse_to_psnr(mse) for mse in (squared_errors / known.clamp_min(1)).tolist()]


def align_cameras(render: RenderFn, corrections: Corrections, draw: Callable[[Sequence[int]], PhotoPixels]) -> None:
    """Fits poses and gains to drawn pixels of each photo by damped least squares, with the field frozen."""
    poses, exposure = (name in corrections.enabled_at for name in ("poses", "exposure"))
    update_columns = slice(POSES.start if poses else EXPOSURE.start, EXPOSURE.stop if exposure else POSES.stop)
    common = corrections.poses.gauge.unflatten(0, (-1, 6))
    unknowns = corrections.poses.pose_adjustment, corrections.color.log_gains

    def errors(photos: Sequence[PhotoPixels]) -> Float[Tensor, "V"]:
        return torch.cat([compute_photo_errors(render, corrections, pixels, 1) for pixels in photos])

    steps = range(0 if poses else JOINT_STEPS, JOINT_STEPS + PER_CAMERA_STEPS)
    for step in track_progress(steps, len(steps), "aligning held-out photos"):
        photos = [draw([view]) for view in range(len(unknowns[0]))]  # one by one, as there may be many
        terms = [compute_residual_jacobian(render, corrections, pixels, 1) for pixels in photos]
        residuals, jacobian = (torch.cat(parts) for parts in zip(*terms, strict=True))
        update = torch.zeros_like(jacobian[:, 0])
        if step < JOINT_STEPS:
            jacobian_of_all = (jacobian[..., POSES] @ common).flatten(0, 1)
            shared = solve_damped_least_squares(residuals.flatten(0, 1)[None], jacobian_of_all[None])
            update[:, POSES] = (common @ shared.mT)[..., 0]
            if exposure:
                update[:, EXPOSURE] = solve_damped_least_squares(residuals, jacobian[..., EXPOSURE])
        else:
            update[:, update_columns] = solve_damped_least_squares(residuals, jacobian[..., update_columns])
        errors_before, values_before = errors(photos), [parameter.data.clone() for parameter in unknowns]
        for parameter, columns in zip(unknowns, (POSES, EXPOSURE), strict=True):
            parameter.data += update[:, columns]
        has_improved = (errors(photos) < errors_before)[:, None]
        for parameter, value in zip(unknowns, values_before, strict=True):
            parameter.data = torch.where(has_improved, parameter.data, value)
