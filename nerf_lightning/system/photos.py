"""How well a trained field explains single photos: those it was trained on, and held-out ones by cameras of their own."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.dataset import Views
from nerf_lightning.refine import Corrections
from nerf_lightning.system.metrics import mse_to_psnr
from nerf_lightning.system.nerf3d import NeRF3D
from nerf_lightning.system.trial import (
    LIGHT,
    POSES,
    Pixels,
    RenderFn,
    derivatives,
    draw_pixels,
    frozen_render,
    least_squares,
    render_pixels,
    squared_errors,
)
from nerf_lightning.utils.progress import tracked
from nerf_lightning.utils.seeding import Stream, step_generator

PIXELS = 256
"""Of each training photo that are compared."""
MIN_DEVIATIONS, MIN_LOSS_DB = 7.0, 6.0
"""A photo stands out if it is this many robust standard deviations, and this many dB, worse than the median."""
HALVES = (0.0, 0.5), (0.5, 1.0)
"""Shares of a held-out photo's columns: one half decides, the other is scored."""
STEPS_TOGETHER, STEPS_APART = 4, 6
"""Least-squares steps of all cameras together, and then of each alone. More would follow the faults of the field there."""
ALIGN_PIXELS, MIN_ALIGN_PIXELS = 2048, 256
"""Of each half, that decide in a step: usually, and where there is little time."""
SCORED_PIXELS = 1 << 15
"""Of each half, that are scored."""
RENDERED_PIXELS = 2 * ((STEPS_TOGETHER + STEPS_APART) * ALIGN_PIXELS * 5 + SCORED_PIXELS)
"""Rendering a photo's pixels so often takes as long as all that is done for it: derivatives take as long as three."""


def psnr_of_photos(system: NeRF3D, views: Views) -> list[float]:
    """PSNR of each training photo in dB, by some of its pixels; nan where none of those is known.

    Cameras and light are taken as corrected, if they are.
    """
    views = views.to(system.device)
    generator = step_generator(system.seed, Stream.STUDY, 2, system.device)
    pixels = draw_pixels(views, range(len(views)), PIXELS, system.renderer.background.color, generator)
    squares = photo_errors(lambda rays, _: system.render(rays), system.corrections, pixels, len(views))
    known = pixels.known.view(len(views), -1).sum(1)
    return [mse_to_psnr(mse) for mse in (squares / (3 * known)).tolist()]


def photo_errors(render: RenderFn, corrections: Corrections | None, pixels: Pixels, photos: int) -> Float[Tensor, "V"]:
    """Squared errors of each photo's pixels as rendered, see `squared_errors`."""
    return squared_errors(render_pixels(render, corrections, pixels), corrections, pixels, photos)


def misfits(psnrs: list[float]) -> list[int]:
    """Numbers of the photos that stand out, worst first.

    The spread of the others is 1.4826 times their median absolute deviation, as of a normal distribution.
    """
    values = torch.tensor(psnrs, dtype=torch.float64)
    middle = values.nanmedian()
    spread = 1.4826 * (values - middle).abs().nanmedian()
    limit = float(middle - max(MIN_LOSS_DB, MIN_DEVIATIONS * float(spread)))
    return sorted((i for i, value in enumerate(psnrs) if value < limit), key=psnrs.__getitem__)


@torch.inference_mode(False)  # a trainer's test is without gradients
def aligned_psnr(system: NeRF3D, views: Views, share: float = 1.0) -> list[float]:
    """PSNR of each held-out photo in dB, by a camera and gains that were found on the half that is not scored.

    Cameras that were corrected may together stand a little apart from where held-out ones are said to be: this figure asks
    how good the field is, and not whether both agree.

    Args:
        system: with corrections.
        views: the held-out photos.
        share: of the pixels that usually decide, as far as `MIN_ALIGN_PIXELS`, for less time.
    """
    assert system.corrections is not None  # else there is nothing to align
    views, behind = views.to(system.device), system.renderer.background.color
    squares, known = torch.zeros(2, len(views), dtype=torch.float64)
    count = max(MIN_ALIGN_PIXELS, round(share * ALIGN_PIXELS))
    for half, other in zip(HALVES, HALVES[::-1], strict=True):
        corrections = system.corrections.for_held_out(views.cameras, system.sampler.bounds).to(system.device)
        generator = step_generator(system.seed, Stream.STUDY, 1, system.device)
        draw = partial(draw_pixels, views, count=count, behind=behind, generator=generator, columns=half)
        align_cameras(frozen_render(system), corrections, draw)
        for view in range(len(views)):
            pixels = draw_pixels(views, [view], SCORED_PIXELS, behind, generator, other)
            squares[view] += float(photo_errors(lambda rays, _: system.render(rays), corrections, pixels, 1))
            known[view] += 3 * int(pixels.known.sum())
    return [mse_to_psnr(mse) for mse in (squares / known.clamp_min(1)).tolist()]


def align_cameras(render: RenderFn, corrections: Corrections, draw: Callable[[Sequence[int]], Pixels]) -> None:
    """Finds corrections with which a field, that stays as it is, fits drawn pixels of each photo best."""
    poses, light = (name in corrections.enabled_at for name in ("poses", "light"))
    own = slice(POSES.start if poses else LIGHT.start, LIGHT.stop if light else POSES.stop)
    common = corrections.poses.gauge.unflatten(0, (-1, 6))
    unknowns = corrections.poses.motions, corrections.color.log_gains

    def errors(photos: Sequence[Pixels]) -> Float[Tensor, "V"]:
        return torch.cat([photo_errors(render, corrections, pixels, 1) for pixels in photos])

    steps = range(0 if poses else STEPS_TOGETHER, STEPS_TOGETHER + STEPS_APART)
    for step in tracked(steps, len(steps), "aligning held-out photos"):
        photos = [draw([view]) for view in range(len(unknowns[0]))]  # one by one, as there may be many
        found = [derivatives(render, corrections, pixels, 1) for pixels in photos]
        left, jacobian = (torch.cat(parts) for parts in zip(*found, strict=True))
        change = torch.zeros_like(jacobian[:, 0])
        if step < STEPS_TOGETHER:
            shared = least_squares(left.flatten(0, 1)[None], (jacobian[..., POSES] @ common).flatten(0, 1)[None])
            change[:, POSES] = (common @ shared.mT)[..., 0]
            if light:
                change[:, LIGHT] = least_squares(left, jacobian[..., LIGHT])
        else:
            change[:, own] = least_squares(left, jacobian[..., own])
        before, given = errors(photos), [parameter.data.clone() for parameter in unknowns]
        for parameter, columns in zip(unknowns, (POSES, LIGHT), strict=True):
            parameter.data += change[:, columns]
        better = (errors(photos) < before)[:, None]
        for parameter, was in zip(unknowns, given, strict=True):
            parameter.data = torch.where(better, parameter.data, was)
