"""Trials of `refine=auto`: whether a least-squares step on some pixels of each photo lowers the error on others.

An L2 prior on corrections that are always on does not do as well. TensoRF after 300 steps of small scenes, median of three
seeds: exact cameras lose nothing by trials, 0.9 dB without prior or trials, 0.5 and 0.2 dB with 1e-4 and 1e-3 of the mean
squared motion in pixels added to the loss; cameras off by 0.5 degrees end 0.4 and 0.6 dB below trials with these, and 2.8 dB
with 1e-2.
"""

import copy
from collections.abc import Callable, Sequence
from functools import partial
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

import lightning as L
import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset import Views
from nerf_lightning.dataset.ray_datamodule import cast_rays
from nerf_lightning.refine import Corrections
from nerf_lightning.refine.gauge import orthonormal_basis, project_out
from nerf_lightning.renderer import RenderOutput, composite_over
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.text import subsample

if TYPE_CHECKING:
    from nerf_lightning.system.nerf3d import NeRF3D

FIRST_TRIAL_STEP, MAX_TRIAL_PROGRESS = 24, 0.4
"""The step of the first trial, with each next one at twice the step of the one before; and the share of the training that they
end with. Large faults show while the field is smooth, as later it has explained them by fog; small ones when it is sharp."""
EARLY_TRIAL_STEPS, EARLY_REDUCTION_FACTOR = 64, 2
"""Steps before which gains are not tried, as a field that is still too dark everywhere wants gains; and how many times as much
poses have to explain before: a field that is still blurred follows any motion a little."""
MIN_ERROR_REDUCTION = {"poses": 0.01, "exposure": 0.05}
"""Share by which most photos' squared error has to fall. Exact poses raise it; gains explain a little of all that is wrong, and
make the neutral look another than that of the photos."""
RETEST_FRACTION, NUM_DRAWS = 0.5, 4
"""Share of `MIN_ERROR_REDUCTION` from which on this many draws of pixels decide, by their mean."""
MAX_PHOTOS, PIXELS_PER_PHOTO = 64, 128
"""How many photos are looked at, and pixels of each that decide; as many others judge."""
LM_DAMPING, MIN_LM_DAMPING = 0.3, 1e-6
"""Shares of each unknown's own effect, and of the mean over a photo's unknowns as some have none, that are added to the normal
equations (Levenberg and Marquardt)."""
POSES, EXPOSURE = slice(0, 6), slice(6, 9)
"""Columns of the unknowns: a camera's `pose_adjustment`, then its `log_gains`."""
RenderFn = Callable[[Rays, Float[Tensor, "R 3"]], RenderOutput]
"""Renders rays onto backgrounds, with gradient in the rays."""


class PhotoPixels(NamedTuple):
    """P pixels of each of V photos, photo by photo."""

    rays: Rays
    views: Int[Tensor, "VP"]
    truth: Float[Tensor, "VP 3"]
    backgrounds: Float[Tensor, "VP 3"]
    known: Bool[Tensor, "VP"]
    """Whether they count."""


def sample_photo_pixels(
    views: Views,
    photos: Sequence[int],
    num_pixels: int,
    background: Float[Tensor, "3"],
    generator: Generator,
    column_range: tuple[float, float] = (0.0, 1.0),
) -> PhotoPixels:
    """Random pixels of some photos, as many of each, drawn with replacement from these shares of their columns."""
    index = torch.tensor(photos, device=background.device)
    down, across = torch.rand(2, len(photos), num_pixels, generator=generator, device=background.device)
    width = views.widths[index, None]
    height = views.offsets.diff()[index, None] // width
    row = torch.minimum((down * height).long(), height - 1)
    first, end = ((side * width).long() for side in column_range)
    column = torch.minimum(first + (across * (end - first)).long(), end - 1)
    indices = (views.offsets[index, None] + row * width + column).flatten()
    rays, view = cast_rays(views, indices)
    backgrounds = background.expand(len(indices), 3)
    return PhotoPixels(rays, view, composite_over(views.pixels[indices], backgrounds), backgrounds, views.mask[indices])


@torch.no_grad()
def render_photo_pixels(render: RenderFn, corrections: Corrections | None, pixels: PhotoPixels) -> RenderOutput:
    """What cameras see through these pixels, as corrected if they are."""
    rays = pixels.rays if corrections is None else corrections.poses(pixels.rays, pixels.views)
    return render(rays, pixels.backgrounds)


@torch.no_grad()
def compute_squared_errors(
    output: RenderOutput, corrections: Corrections | None, pixels: PhotoPixels, num_photos: int
) -> Float[Tensor, "V"]:
    """Of each photo: the sum over its known pixels and their channels, in corrected light if it is."""
    rgb = output.rgb
    if corrections is not None:
        rgb = corrections.color(rgb, output.opacity, pixels.backgrounds, pixels.rays, pixels.views)
    return ((rgb.clamp(0, 1) - pixels.truth).square().sum(1) * pixels.known).view(num_photos, -1).sum(1)


def compute_residual_jacobian(
    render: RenderFn, corrections: Corrections, pixels: PhotoPixels, num_photos: int
) -> tuple[Float[Tensor, "V P 1"], Float[Tensor, "V P 9"]]:
    """What is left to explain of one channel of each pixel, red, green and blue in turn, and how it follows its photo's
    `pose_adjustment` and `log_gains`. All three channels would cost three times the gradient and say little more."""
    with torch.no_grad():
        rays = corrections.poses(pixels.rays, pixels.views)
    origins, directions = (x.detach().requires_grad_() for x in (rays.origins, rays.directions))
    channel = (torch.arange(len(pixels.views), device=directions.device) % 3)[:, None]
    with torch.enable_grad():
        output = render(Rays(origins, directions), pixels.backgrounds)
        rgb = corrections.color(output.rgb, output.opacity, pixels.backgrounds, pixels.rays, pixels.views, pixels.truth)
        translations, rotations = torch.autograd.grad(rgb.gather(1, channel).sum(), (origins, directions))
    with torch.no_grad():
        rotations = torch.linalg.cross(directions, rotations, dim=1)
        scales = corrections.poses.preconditioner.index_select(0, pixels.views)
        by_motion = torch.cat([rotations, translations], dim=1)[:, None] @ scales
        foreground = rgb - (1 - output.opacity)[:, None] * pixels.backgrounds
        by_gain = torch.zeros_like(foreground).scatter(1, channel, foreground.gather(1, channel))
        counted = pixels.known[:, None].float()
        jacobian = torch.cat([by_motion[:, 0], by_gain], dim=1) * counted
        residuals = (pixels.truth - rgb).gather(1, channel) * counted
        return residuals.view(num_photos, -1, 1), jacobian.view(num_photos, -1, 9)


def solve_damped_least_squares(
    residuals: Float[Tensor, "V N 1"], jacobian: Float[Tensor, "V N K"]
) -> Float[Tensor, "V K"]:
    """Of each photo, the change of its K unknowns that explains most of what is left."""
    square = jacobian.mT @ jacobian
    own = square.diagonal(dim1=1, dim2=2)
    damping = LM_DAMPING * own + MIN_LM_DAMPING * own.mean(1, keepdim=True) + torch.finfo(own.dtype).tiny ** 0.5
    return torch.linalg.solve(square + torch.diag_embed(damping), jacobian.mT @ residuals)[..., 0]


@torch.no_grad()
def apply_update(
    corrections: Corrections, photos: Sequence[int], pose_adjustment: Tensor | None, log_gains: Tensor | None
) -> Corrections:
    """A copy of corrections with these changes of some photos, but for what those have in common."""
    trial = copy.deepcopy(corrections)
    if pose_adjustment is not None:
        trial.poses.pose_adjustment.requires_grad_(True)
        common = orthonormal_basis(corrections.poses.gauge.unflatten(0, (-1, 6))[photos].flatten(0, 1))
        trial.poses.pose_adjustment[photos] += project_out(pose_adjustment, common)
    if log_gains is not None:
        trial.color.log_gains.requires_grad_(True)
        trial.color.log_gains[photos] += log_gains - log_gains.mean(0)
    return trial


def measure_error_reductions(
    render: RenderFn,
    views: Views,
    background: Float[Tensor, "3"],
    corrections: Corrections,
    generator: Generator,
    exposure: bool = True,
) -> dict[str, float]:
    """By what share of itself a photo's squared error falls on pixels that did not decide, if a field that stays as it is may
    be seen by corrected cameras ("poses") and exposure ("exposure"), each with or without the other, or in light by the
    stated exposures alone ("exif"): the median over photos, since a few in which something moved say nothing of the others.

    Args:
        render: of the field.
        views: the training photos.
        background: the colour behind the scene.
        corrections: those that there are already; they are not changed.
        generator: of the pixels.
        exposure: whether to ask about exposure too; poses alone take less time.
    """
    photos = subsample(len(views), MAX_PHOTOS)
    fit_pixels, test_pixels = (
        sample_photo_pixels(views, photos, PIXELS_PER_PHOTO, background, generator) for _ in range(2)
    )
    residuals, jacobian = compute_residual_jacobian(render, corrections, fit_pixels, len(photos))

    def errors(pose_adjustment: Tensor | None, log_gains: Tensor | None) -> Float[Tensor, "V"]:
        trial = apply_update(corrections, photos, pose_adjustment, log_gains)
        output = unmoved if pose_adjustment is None else render_photo_pixels(render, trial, test_pixels)
        return compute_squared_errors(output, trial, test_pixels, len(photos))

    unmoved = render_photo_pixels(render, corrections, test_pixels)
    unchanged = errors(None, None)
    only_poses = errors(solve_damped_least_squares(residuals, jacobian[..., POSES]), None)
    decreases = {"poses": unchanged - only_poses}
    if exposure:
        both = solve_damped_least_squares(residuals, jacobian)
        corrected = errors(both[:, POSES], both[:, EXPOSURE])
        only_exposure = errors(None, solve_damped_least_squares(residuals, jacobian[..., EXPOSURE]))
        decreases = {
            "poses": torch.minimum(unchanged, only_exposure) - torch.minimum(only_poses, corrected),
            "exposure": torch.minimum(unchanged, only_poses) - torch.minimum(only_exposure, corrected),
            "exif": unchanged - errors(None, corrections.color.exif_log_gains[photos]),
        }
    fractions = {name: by / unchanged for name, by in decreases.items()}  # nan where all is masked
    return {name: float(fraction.nanmedian().nan_to_num()) for name, fraction in fractions.items()}


def freeze_renderer(system: "NeRF3D") -> RenderFn:
    """Renders without randomness and with gradient in the rays alone: the field does not learn from it."""
    field, renderer = copy.deepcopy(system.field).requires_grad_(False), copy.deepcopy(system.renderer).eval()

    def render(rays: Rays, background: Tensor) -> RenderOutput:
        with torch.no_grad():
            samples = system.sampler(rays.detach(), field.density)
        return renderer(rays, samples, field, background)

    return render


def list_candidates(corrections: Corrections, step: int, progress: float) -> list[str]:
    """What a trial at this step is to decide on; none where no trial is due."""
    doublings, rest = divmod(step, FIRST_TRIAL_STEP)
    is_trial_step = step > 0 and not rest and not doublings & (doublings - 1) and progress <= MAX_TRIAL_PROGRESS
    if not corrections.auto or not is_trial_step:
        return []
    names = (
        corrections.learning_rates if step >= EARLY_TRIAL_STEPS else corrections.learning_rates.keys() - {"exposure"}
    )
    return [name for name in names if name not in corrections.enabled_at]


def select_corrections(
    candidates: Sequence[str], step: int, reductions: dict[str, float], fraction: float = 1.0
) -> list[str]:
    """What helps by a trial at this step that said this; or might, as it explains this share of what it has to."""
    factor = fraction * (EARLY_REDUCTION_FACTOR if step < EARLY_TRIAL_STEPS else 1)
    return [name for name in candidates if reductions[name] > factor * MIN_ERROR_REDUCTION[name]]


class CorrectionTrials(L.Callback):
    """Corrects cameras and light from the first trial on that shows that it helps; where it might, more pixels are asked."""

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: "NeRF3D", batch: Any, batch_idx: int) -> None:
        corrections, step, progress = pl_module.corrections, trainer.global_step, pl_module.state.progress
        if corrections is None or not (candidates := list_candidates(corrections, step, progress)):
            return
        views = pl_module.datamodule.scene.train.to(pl_module.device)
        generator = step_generator(pl_module.seed, Stream.REFINEMENT_TRIAL, step, pl_module.device)
        background, exposure = pl_module.renderer.background.color, "exposure" in candidates
        measure = partial(
            measure_error_reductions, freeze_renderer(pl_module), views, background, corrections, generator, exposure
        )
        reductions = measure()
        if select_corrections(candidates, step, reductions, RETEST_FRACTION):
            several = [reductions, *(measure() for _ in range(NUM_DRAWS - 1))]
            reductions = {name: fmean(one[name] for one in several) for name in reductions}
        selected = select_corrections(candidates, step, reductions)
        corrections.record_trial(
            progress, selected, {name: reductions[name] for name in candidates}, reductions.get("exif", 0.0) > 0
        )
