"""Held-out photos whose own cameras and light are corrected too: half of a photo decides, the other half is scored."""

import copy

import torch
from jaxtyping import Int
from torch import Tensor

from nerf_lightning.dataset import Views
from nerf_lightning.dataset.rays import rays_through
from nerf_lightning.refine import Corrections
from nerf_lightning.renderer import over
from nerf_lightning.system.metrics import mse_to_psnr
from nerf_lightning.system.nerf3d import NeRF3D
from nerf_lightning.system.trial import (
    LIGHT,
    POSES,
    derivatives,
    frozen_render,
    least_squares,
    seen_by,
    some_pixels,
    squared_errors,
)
from nerf_lightning.utils.progress import tracked
from nerf_lightning.utils.seeding import Stream, step_generator

COLUMNS = (0.0, 0.5), (0.5, 1.0)
"""Shares of them that make the left and the right half."""
PIXELS, MIN_PIXELS = 2048, 256
"""Of each photo's half, that decide in a step: usually, and where there is little time."""
SCORED_PIXELS = 1 << 15
"""Most of each photo's half that are scored, evenly spaced."""
TOGETHER, APART = 4, 6
"""Least-squares steps of all cameras together, and then of each alone. More would follow the faults of the field there."""
RENDERED_PIXELS = 2 * ((TOGETHER + APART) * PIXELS * 5 + SCORED_PIXELS)
"""Rendering a photo's pixels so often takes as long as all that is done for it: derivatives take as long as three."""


def halves(views: Views, view: int) -> tuple[Int[Tensor, "L"], Int[Tensor, "R"]]:
    """The places in `Views.pixels` of the known pixels in a photo's left and right half."""
    known = views.mask_of(view)
    left = torch.arange(known.shape[1], device=known.device) < known.shape[1] // 2
    start = int(views.starts[view])
    first, second = (start + (known & side).flatten().nonzero()[:, 0] for side in (left, ~left))
    return first, second


def fitted(system: NeRF3D, views: Views, half: int, corrections: Corrections, count: int) -> None:
    """Finds corrections with which a field, that stays as it is, fits `count` pixels of this half of each photo best."""
    see, behind = frozen_render(system), system.renderer.background.color
    generator = step_generator(system.seed, Stream.STUDY, 1, system.device)
    poses, light = ("poses" in corrections.enabled_at), ("light" in corrections.enabled_at)
    together = TOGETHER if poses else 0
    for step in tracked(range(together + APART), together + APART, "aligning held-out photos"):
        # Photo by photo, as there may be many of them.
        photos = [some_pixels(views, [i], count, behind, generator, COLUMNS[half]) for i in range(len(views))]
        found = [derivatives(see, corrections, pixels, 1) for pixels in photos]
        left, jacobian = (torch.cat(parts) for parts in zip(*found, strict=True))
        change = torch.zeros_like(jacobian[:, 0])
        if step < together:
            common = corrections.poses.gauge.unflatten(0, (-1, 6))
            shared = least_squares(left.flatten(0, 1)[None], (jacobian[..., POSES] @ common).flatten(0, 1)[None])
            change[:, POSES] = (common @ shared.mT)[..., 0]
            if light:
                change[:, LIGHT] = least_squares(left, jacobian[..., LIGHT])
        else:
            own = slice(POSES.start if poses else LIGHT.start, LIGHT.stop if light else POSES.stop)
            change[:, own] = least_squares(left, jacobian[..., own])
        other = copy.deepcopy(corrections)
        other.poses.motions.data += change[:, POSES]
        other.color.log_gains.data += change[:, LIGHT]
        before, after = (
            torch.cat([squared_errors(seen_by(see, by, pixels), by, pixels, 1) for pixels in photos])
            for by in (corrections, other)
        )
        better = (after < before)[:, None]
        for parameter, changed in (
            (corrections.poses.motions, other.poses.motions),
            (corrections.color.log_gains, other.color.log_gains),
        ):
            parameter.data = torch.where(better, changed.data, parameter.data)


@torch.inference_mode(False)  # a trainer's test is without gradients
@torch.enable_grad()
def aligned_psnr(system: NeRF3D, views: Views, share: float = 1.0) -> list[float]:
    """PSNR of each held-out photo in dB, by a camera and gains that were found on the half that is not scored.

    Cameras that were corrected may together stand a little apart from where held-out ones are said to be: this figure asks
    how good the field is, and not whether both agree.

    Args:
        system: with corrections.
        views: the held-out photos.
        share: of the pixels that usually decide, as far as `MIN_PIXELS`, for less time.
    """
    assert system.corrections is not None  # else there is nothing to align
    views = views.to(system.device)
    parts = [[half[:: -(-len(half) // SCORED_PIXELS)] for half in halves(views, view)] for view in range(len(views))]
    squares, counts = torch.zeros(len(views), dtype=torch.float64), torch.zeros(len(views))
    for side in (0, 1):
        corrections = system.corrections.for_held_out(views.cameras, system.sampler.bounds).to(system.device)
        fitted(system, views, side, corrections, max(MIN_PIXELS, round(share * PIXELS)))
        with torch.no_grad():
            for view, part in enumerate(parts):
                given, of = rays_through(views, part[1 - side])
                seen, behind = system.render(corrections.poses(given, of)), system.renderer.background.sample(len(of))
                rgb = corrections.color(seen.rgb, seen.opacity, behind, given, of).clamp(0, 1)
                squares[view] += float((rgb - over(views.pixels[part[1 - side]], behind)).square().sum())
                counts[view] += rgb.numel()
    return [mse_to_psnr(mse) for mse in (squares / counts.clamp_min(1)).tolist()]
