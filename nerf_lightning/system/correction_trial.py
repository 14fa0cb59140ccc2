"""Correction trials of `refine=auto`: does one least-squares update, fitted to some pixels, lower the error on others?

An L2 prior on corrections that are always on does worse. TensoRF after 300 steps on small scenes, median of three seeds: with
exact cameras trials cost nothing, no prior and no trials 0.9 dB, priors of 1e-4 and 1e-3 of the mean squared motion in pixels
0.5 and 0.2 dB; with cameras off by 0.5 degrees, these priors end 0.4 and 0.6 dB below trials, and one of 1e-2 2.8 dB.
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
"""Step of the first trial, each later one at twice the step, and training progress after which there are none. Large pose
errors show while the field is smooth, as later it has explained them by fog; small ones once it is sharp."""
EARLY_TRIAL_STEPS, EARLY_REDUCTION_FACTOR = 64, 2
"""Before this step gains are not tried, as a field that is still dark asks for gains, and poses need this multiple of their
error reduction: a blurred field follows any motion a little."""
MIN_ERROR_REDUCTION = {"poses": 0.01, "exposure": 0.05}
"""Relative reduction of most photos' squared error that enables a correction. Exact poses raise the error; gains explain a
little of any error, and shift the photos' neutral color."""
RETEST_FRACTION, NUM_DRAWS = 0.5, 4
"""Above this fraction of `MIN_ERROR_REDUCTION` a trial is repeated; the mean of this many pixel draws decides."""
MAX_PHOTOS, PIXELS_PER_PHOTO = 64, 128
"""Photos per trial, and pixels fitted in each; equally many are tested."""
LM_DAMPING, MIN_LM_DAMPING = 0.3, 1e-6
"""Levenberg-Marquardt damping, relative to each diagonal entry of the normal equations and to their mean over a photo."""
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
    """False where masked."""


def sample_photo_pixels(
    views: Views,
    photos: Sequence[int],
    num_pixels: int,
    background: Float[Tensor, "3"],
    generator: Generator,
    column_range: tuple[float, float] = (0.0, 1.0),
) -> PhotoPixels:
    """Random pixels of each photo, drawn with replacement from a range of columns (fractions of the width)."""
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
    """Renders the pixels, through corrected cameras if `corrections` is given."""
    rays = pixels.rays if corrections is None else corrections.poses(pixels.rays, pixels.views)
    return render(rays, pixels.backgrounds)


@torch.no_grad()
def compute_squared_errors(
    output: RenderOutput, corrections: Corrections | None, pixels: PhotoPixels, num_photos: int
) -> Float[Tensor, "V"]:
    """Squared error of each photo, summed over known pixels and channels, with corrected colors if given."""
    rgb = output.rgb
    if corrections is not None:
        rgb = corrections.color(rgb, output.opacity, pixels.backgrounds, pixels.rays, pixels.views)
    return ((rgb.clamp(0, 1) - pixels.truth).square().sum(1) * pixels.known).view(num_photos, -1).sum(1)


def compute_residual_jacobian(
    render: RenderFn, corrections: Corrections, pixels: PhotoPixels, num_photos: int
) -> tuple[Float[Tensor, "V P 1"], Float[Tensor, "V P 9"]]:
    """Residuals of one channel per pixel (R, G, B in turn), and their Jacobian in `pose_adjustment` and `log_gains`. All three
    channels would cost three times the gradient and add little."""
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
        pose_jacobian = torch.cat([rotations, translations], dim=1)[:, None] @ scales
        foreground = rgb - (1 - output.opacity)[:, None] * pixels.backgrounds
        gain_jacobian = torch.zeros_like(foreground).scatter(1, channel, foreground.gather(1, channel))
        valid = pixels.known[:, None].float()
        jacobian = torch.cat([pose_jacobian[:, 0], gain_jacobian], dim=1) * valid
        residuals = (pixels.truth - rgb).gather(1, channel) * valid
        return residuals.view(num_photos, -1, 1), jacobian.view(num_photos, -1, 9)


def solve_damped_least_squares(
    residuals: Float[Tensor, "V N 1"], jacobian: Float[Tensor, "V N K"]
) -> Float[Tensor, "V K"]:
    """Levenberg-Marquardt update of each photo's K unknowns."""
    normal_matrix = jacobian.mT @ jacobian
    diag = normal_matrix.diagonal(dim1=1, dim2=2)
    damping = LM_DAMPING * diag + MIN_LM_DAMPING * diag.mean(1, keepdim=True) + torch.finfo(diag.dtype).tiny ** 0.5
    return torch.linalg.solve(normal_matrix + torch.diag_embed(damping), jacobian.mT @ residuals)[..., 0]


@torch.no_grad()
def apply_update(
    corrections: Corrections, photos: Sequence[int], pose_adjustment: Tensor | None, log_gains: Tensor | None
) -> Corrections:
    """Copies the corrections and updates some photos, with gauge modes and mean gain projected out."""
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
    """Relative reduction of test pixels' squared error by one update with the field frozen, median over photos.

    Of "poses" and "exposure", each with or without the other, and of the stated exposures alone ("exif"). The median, since a
    few photos in which something moved say nothing about the others.

    Args:
        render: renders the field.
        views: the training photos.
        background: the color behind the scene.
        corrections: current corrections; not changed.
        generator: draws the pixels.
        exposure: also measures exposure; poses alone are faster.
    """
    photos = subsample(len(views), MAX_PHOTOS)
    draw = partial(sample_photo_pixels, views, photos, PIXELS_PER_PHOTO, background, generator)
    fit_pixels, test_pixels = draw(), draw()
    residuals, jacobian = compute_residual_jacobian(render, corrections, fit_pixels, len(photos))

    def errors(pose_adjustment: Tensor | None, log_gains: Tensor | None) -> Float[Tensor, "V"]:
        trial = apply_update(corrections, photos, pose_adjustment, log_gains)
        output = baseline_output if pose_adjustment is None else render_photo_pixels(render, trial, test_pixels)
        return compute_squared_errors(output, trial, test_pixels, len(photos))

    baseline_output = render_photo_pixels(render, corrections, test_pixels)
    baseline = errors(None, None)
    only_poses = errors(solve_damped_least_squares(residuals, jacobian[..., POSES]), None)
    decreases = {"poses": baseline - only_poses}
    if exposure:
        joint = solve_damped_least_squares(residuals, jacobian)
        poses_and_exposure = errors(joint[:, POSES], joint[:, EXPOSURE])
        only_exposure = errors(None, solve_damped_least_squares(residuals, jacobian[..., EXPOSURE]))
        decreases = {
            "poses": torch.minimum(baseline, only_exposure) - torch.minimum(only_poses, poses_and_exposure),
            "exposure": torch.minimum(baseline, only_poses) - torch.minimum(only_exposure, poses_and_exposure),
            "exif": baseline - errors(None, corrections.color.exif_log_gains[photos]),
        }
    fractions = {name: decrease / baseline for name, decrease in decreases.items()}  # nan where all is masked
    return {name: float(fraction.nanmedian().nan_to_num()) for name, fraction in fractions.items()}


def freeze_renderer(system: "NeRF3D") -> RenderFn:
    """Renders copies of field and renderer without randomness; only the rays get gradients."""
    field, renderer = copy.deepcopy(system.field).requires_grad_(False), copy.deepcopy(system.renderer).eval()

    def render(rays: Rays, background: Tensor) -> RenderOutput:
        with torch.no_grad():
            samples = system.sampler(rays.detach(), field.density)
        return renderer(rays, samples, field, background)

    return render


def list_candidates(corrections: Corrections, step: int, progress: float) -> list[str]:
    """Corrections that a trial at this step decides on; empty if no trial is due."""
    doublings, rest = divmod(step, FIRST_TRIAL_STEP)
    is_trial_step = step > 0 and not rest and not doublings & (doublings - 1) and progress <= MAX_TRIAL_PROGRESS
    if not corrections.auto or not is_trial_step:
        return []
    skipped = {"exposure"} if step < EARLY_TRIAL_STEPS else set()
    return [name for name in corrections.learning_rates if name not in corrections.enabled_at.keys() | skipped]


def select_corrections(
    candidates: Sequence[str], step: int, reductions: dict[str, float], fraction: float = 1.0
) -> list[str]:
    """Candidates whose error reduction exceeds `fraction` of their threshold."""
    factor = fraction * (EARLY_REDUCTION_FACTOR if step < EARLY_TRIAL_STEPS else 1)
    return [name for name in candidates if reductions[name] > factor * MIN_ERROR_REDUCTION[name]]


class CorrectionTrials(L.Callback):
    """Runs the trials of `refine=auto` and enables corrections that help; inconclusive trials are repeated."""

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: "NeRF3D", batch: Any, batch_idx: int) -> None:
        corrections, step, progress = pl_module.corrections, trainer.global_step, pl_module.state.progress
        if corrections is None or not (candidates := list_candidates(corrections, step, progress)):
            return
        views = pl_module.datamodule.scene.train.to(pl_module.device)
        generator = step_generator(pl_module.seed, Stream.REFINEMENT_TRIAL, step, pl_module.device)
        background, exposure = pl_module.renderer.background.color, "exposure" in candidates
        arguments = freeze_renderer(pl_module), views, background, corrections, generator, exposure
        measure = partial(measure_error_reductions, *arguments)
        reductions = measure()
        if select_corrections(candidates, step, reductions, RETEST_FRACTION):
            draws = [reductions, *(measure() for _ in range(NUM_DRAWS - 1))]
            reductions = {name: fmean(draw[name] for draw in draws) for name in reductions}
        selected = select_corrections(candidates, step, reductions)
        measured = {name: reductions[name] for name in candidates}
        corrections.record_trial(progress, selected, measured, reductions.get("exif", 0.0) > 0)
