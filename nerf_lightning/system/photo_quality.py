"""How well a trained field explains single photos: those it was trained on, and held-out ones by cameras of their own."""

from collections.abc import Callable, Sequence
from functools import partial

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
"""Of each training photo that are compared."""
MIN_OUTLIER_DEVIATIONS, MIN_OUTLIER_GAP_DB = 7.0, 6.0
"""A photo stands out if it is this many robust standard deviations, and this many dB, worse than the median."""
IMAGE_HALVES = (0.0, 0.5), (0.5, 1.0)
"""Shares of a held-out photo's columns: one half decides, the other is scored."""
JOINT_STEPS, PER_CAMERA_STEPS = 4, 6
"""Least-squares steps of all cameras together, and then of each alone. More would follow the faults of the field there."""
ALIGN_PIXELS, MIN_ALIGN_PIXELS = 2048, 256
"""Of each half, that decide in a step: usually, and where there is little time."""
SCORED_PIXELS = 1 << 15
"""Of each half, that are scored."""
ALIGN_COST_PIXELS = 2 * ((JOINT_STEPS + PER_CAMERA_STEPS) * ALIGN_PIXELS * 5 + SCORED_PIXELS)
"""Rendering a photo's pixels so often takes as long as all that is done for it: derivatives take as long as three."""


def measure_photo_psnr(system: NeRF3D, views: Views) -> list[float]:
    """PSNR of each training photo in dB, by some of its pixels; nan where none of those is known.

    Cameras and light are taken as corrected, if they are.
    """
    views = views.to(system.device)
    generator = step_generator(system.seed, Stream.ANALYSIS, 2, system.device)
    pixels = sample_photo_pixels(
        views, range(len(views)), PIXELS_PER_PHOTO, system.renderer.background.color, generator
    )
    squared_errors = compute_photo_errors(lambda rays, _: system.render(rays), system.corrections, pixels, len(views))
    known = pixels.known.view(len(views), -1).sum(1)
    return [mse_to_psnr(mse) for mse in (squared_errors / (3 * known)).tolist()]


def compute_photo_errors(
    render: RenderFn, corrections: Corrections | None, pixels: PhotoPixels, num_photos: int
) -> Float[Tensor, "V"]:
    """Squared errors of each photo's pixels as rendered, see `compute_squared_errors`."""
    return compute_squared_errors(render_photo_pixels(render, corrections, pixels), corrections, pixels, num_photos)


def find_outlier_photos(psnrs: list[float]) -> list[int]:
    """Numbers of the photos that stand out, worst first.

    The spread of the others is 1.4826 times their median absolute deviation, as of a normal distribution.
    """
    values = torch.tensor(psnrs, dtype=torch.float64)
    middle = values.nanmedian()
    spread = 1.4826 * (values - middle).abs().nanmedian()
    limit = float(middle - max(MIN_OUTLIER_GAP_DB, MIN_OUTLIER_DEVIATIONS * float(spread)))
    return sorted((i for i, value in enumerate(psnrs) if value < limit), key=psnrs.__getitem__)


@torch.inference_mode(False)  # a trainer's test is without gradients
def measure_aligned_psnr(system: NeRF3D, views: Views, fraction: float = 1.0) -> list[float]:
    """PSNR of each held-out photo in dB, by a camera and gains that were found on the half that is not scored.

    Cameras that were corrected may together stand a little apart from where held-out ones are said to be: this figure asks
    how good the field is, and not whether both agree.

    Args:
        system: with corrections.
        views: the held-out photos.
        fraction: of the pixels that usually decide, as far as `MIN_ALIGN_PIXELS`, for less time.
    """
    assert system.corrections is not None  # else there is nothing to align
    views, background = views.to(system.device), system.renderer.background.color
    squared_errors, known = torch.zeros(2, len(views), dtype=torch.float64)
    num_pixels = max(MIN_ALIGN_PIXELS, round(fraction * ALIGN_PIXELS))
    for half, other in zip(IMAGE_HALVES, IMAGE_HALVES[::-1], strict=True):
        corrections = system.corrections.make_held_out_corrections(views.cameras, system.sampler.bounds).to(
            system.device
        )
        generator = step_generator(system.seed, Stream.ANALYSIS, 1, system.device)
        draw = partial(
            sample_photo_pixels,
            views,
            num_pixels=num_pixels,
            background=background,
            generator=generator,
            column_range=half,
        )
        align_cameras(freeze_renderer(system), corrections, draw)
        for view in range(len(views)):
            pixels = sample_photo_pixels(views, [view], SCORED_PIXELS, background, generator, other)
            squared_errors[view] += float(
                compute_photo_errors(lambda rays, _: system.render(rays), corrections, pixels, 1)
            )
            known[view] += 3 * int(pixels.known.sum())
    return [mse_to_psnr(mse) for mse in (squared_errors / known.clamp_min(1)).tolist()]


def align_cameras(render: RenderFn, corrections: Corrections, draw: Callable[[Sequence[int]], PhotoPixels]) -> None:
    """Finds corrections with which a field, that stays as it is, fits drawn pixels of each photo best."""
    poses, exposure = (name in corrections.enabled_at for name in ("poses", "exposure"))
    update_columns = slice(POSES.start if poses else EXPOSURE.start, EXPOSURE.stop if exposure else POSES.stop)
    common = corrections.poses.gauge.unflatten(0, (-1, 6))
    unknowns = corrections.poses.pose_adjustment, corrections.color.log_gains

    def errors(photos: Sequence[PhotoPixels]) -> Float[Tensor, "V"]:
        return torch.cat([compute_photo_errors(render, corrections, pixels, 1) for pixels in photos])

    steps = range(0 if poses else JOINT_STEPS, JOINT_STEPS + PER_CAMERA_STEPS)
    for step in track_progress(steps, len(steps), "aligning held-out photos"):
        photos = [draw([view]) for view in range(len(unknowns[0]))]  # one by one, as there may be many
        found = [compute_residual_jacobian(render, corrections, pixels, 1) for pixels in photos]
        residuals, jacobian = (torch.cat(parts) for parts in zip(*found, strict=True))
        change = torch.zeros_like(jacobian[:, 0])
        if step < JOINT_STEPS:
            shared = solve_damped_least_squares(
                residuals.flatten(0, 1)[None], (jacobian[..., POSES] @ common).flatten(0, 1)[None]
            )
            change[:, POSES] = (common @ shared.mT)[..., 0]
            if exposure:
                change[:, EXPOSURE] = solve_damped_least_squares(residuals, jacobian[..., EXPOSURE])
        else:
            change[:, update_columns] = solve_damped_least_squares(residuals, jacobian[..., update_columns])
        before, before_update = errors(photos), [parameter.data.clone() for parameter in unknowns]
        for parameter, columns in zip(unknowns, (POSES, EXPOSURE), strict=True):
            parameter.data += change[:, columns]
        better = (errors(photos) < before)[:, None]
        for parameter, value in zip(unknowns, before_update, strict=True):
            parameter.data = torch.where(better, parameter.data, value)
