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
from nerf_lightning.dataset.rays import rays_through
from nerf_lightning.refine import Corrections
from nerf_lightning.refine.gauge import orthonormal_basis, project_out
from nerf_lightning.renderer import RenderOutput, over
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.text import subsample

if TYPE_CHECKING:
    from nerf_lightning.system.nerf3d import NeRF3D

FIRST_TRIAL_STEP, MAX_TRIAL_PROGRESS = 24, 0.4
"""The step of the first trial, with each next one at twice the step of the one before; and the share of the training that they
end with. Large faults show while the field is smooth, as later it has explained them by fog; small ones when it is sharp."""
EARLY_STEPS, EARLY_FACTOR = 64, 2
"""Steps before which gains are not tried, as a field that is still too dark everywhere wants gains; and how many times as much
poses have to explain before: a field that is still blurred follows any motion a little."""
MIN_GAIN = {"poses": 0.01, "light": 0.05}
"""Share by which most photos' squared error has to fall. Exact poses raise it; gains explain a little of all that is wrong, and
make the neutral look another than that of the photos."""
UNSURE_SHARE, DRAWS = 0.5, 4
"""Share of `MIN_GAIN` from which on this many draws of pixels decide, by their mean."""
PHOTOS, PIXELS = 64, 128
"""How many photos are looked at, and pixels of each that decide; as many others judge."""
DAMPING, MIN_DAMPING = 0.3, 1e-6
"""Shares of each unknown's own effect, and of the mean over a photo's unknowns as some have none, that are added to the normal
equations (Levenberg and Marquardt)."""
POSES, LIGHT = slice(0, 6), slice(6, 9)
"""Columns of the unknowns: a camera's `motions`, then its `log_gains`."""
RenderFn = Callable[[Rays, Float[Tensor, "R 3"]], RenderOutput]
"""Renders rays onto backgrounds, with gradient in the rays."""


class Pixels(NamedTuple):
    """P pixels of each of V photos, photo by photo."""

    rays: Rays
    views: Int[Tensor, "VP"]
    truth: Float[Tensor, "VP 3"]
    behind: Float[Tensor, "VP 3"]
    known: Bool[Tensor, "VP"]
    """Whether they count."""


def draw_pixels(
    views: Views,
    chosen: Sequence[int],
    count: int,
    behind: Float[Tensor, "3"],
    generator: Generator,
    columns: tuple[float, float] = (0.0, 1.0),
) -> Pixels:
    """Random pixels of some photos, as many of each, drawn with replacement from these shares of their columns."""
    photos = torch.tensor(chosen, device=behind.device)
    down, across = torch.rand(2, len(chosen), count, generator=generator, device=behind.device)
    width = views.widths[photos, None]
    height = views.starts.diff()[photos, None] // width
    row = torch.minimum((down * height).long(), height - 1)
    first, end = ((side * width).long() for side in columns)
    column = torch.minimum(first + (across * (end - first)).long(), end - 1)
    places = (views.starts[photos, None] + row * width + column).flatten()
    rays, view = rays_through(views, places)
    backgrounds = behind.expand(len(places), 3)
    return Pixels(rays, view, over(views.pixels[places], backgrounds), backgrounds, views.mask[places])


@torch.no_grad()
def render_pixels(render: RenderFn, corrections: Corrections | None, pixels: Pixels) -> RenderOutput:
    """What cameras see through these pixels, as corrected if they are."""
    rays = pixels.rays if corrections is None else corrections.poses(pixels.rays, pixels.views)
    return render(rays, pixels.behind)


@torch.no_grad()
def squared_errors(
    seen: RenderOutput, corrections: Corrections | None, pixels: Pixels, photos: int
) -> Float[Tensor, "V"]:
    """Of each photo: the sum over its known pixels and their channels, in corrected light if it is."""
    rgb = seen.rgb
    if corrections is not None:
        rgb = corrections.color(rgb, seen.opacity, pixels.behind, pixels.rays, pixels.views)
    return ((rgb.clamp(0, 1) - pixels.truth).square().sum(1) * pixels.known).view(photos, -1).sum(1)


def derivatives(
    render: RenderFn, corrections: Corrections, pixels: Pixels, photos: int
) -> tuple[Float[Tensor, "V P 1"], Float[Tensor, "V P 9"]]:
    """What is left to explain of one channel of each pixel, red, green and blue in turn, and how it follows its photo's
    `motions` and `log_gains`. All three channels would cost three times the gradient and say little more."""
    with torch.no_grad():
        rays = corrections.poses(pixels.rays, pixels.views)
    origins, directions = (x.detach().requires_grad_() for x in (rays.origins, rays.directions))
    channel = (torch.arange(len(pixels.views), device=directions.device) % 3)[:, None]
    with torch.enable_grad():
        seen = render(Rays(origins, directions), pixels.behind)
        rgb = corrections.color(seen.rgb, seen.opacity, pixels.behind, pixels.rays, pixels.views, pixels.truth)
        moves, turns = torch.autograd.grad(rgb.gather(1, channel).sum(), (origins, directions))
    with torch.no_grad():
        turns = torch.linalg.cross(directions, turns, dim=1)
        scales = corrections.poses.preconditioner.index_select(0, pixels.views)
        by_motion = torch.cat([turns, moves], dim=1)[:, None] @ scales
        lit = rgb - (1 - seen.opacity)[:, None] * pixels.behind
        by_gain = torch.zeros_like(lit).scatter(1, channel, lit.gather(1, channel))
        counted = pixels.known[:, None].float()
        jacobian = torch.cat([by_motion[:, 0], by_gain], dim=1) * counted
        left = (pixels.truth - rgb).gather(1, channel) * counted
        return left.view(photos, -1, 1), jacobian.view(photos, -1, 9)


def least_squares(left: Float[Tensor, "V N 1"], jacobian: Float[Tensor, "V N K"]) -> Float[Tensor, "V K"]:
    """Of each photo, the change of its K unknowns that explains most of what is left."""
    square = jacobian.mT @ jacobian
    own = square.diagonal(dim1=1, dim2=2)
    damping = DAMPING * own + MIN_DAMPING * own.mean(1, keepdim=True) + torch.finfo(own.dtype).tiny ** 0.5
    return torch.linalg.solve(square + torch.diag_embed(damping), jacobian.mT @ left)[..., 0]


@torch.no_grad()
def apply_changes(
    corrections: Corrections, chosen: Sequence[int], motions: Tensor | None, log_gains: Tensor | None
) -> Corrections:
    """A copy of corrections with these changes of some photos, but for what those have in common."""
    trial = copy.deepcopy(corrections)
    if motions is not None:
        trial.poses.motions.requires_grad_(True)
        common = orthonormal_basis(corrections.poses.gauge.unflatten(0, (-1, 6))[chosen].flatten(0, 1))
        trial.poses.motions[chosen] += project_out(motions, common)
    if log_gains is not None:
        trial.color.log_gains.requires_grad_(True)
        trial.color.log_gains[chosen] += log_gains - log_gains.mean(0)
    return trial


def measure_gains(
    render: RenderFn,
    views: Views,
    behind: Float[Tensor, "3"],
    corrections: Corrections,
    generator: Generator,
    light: bool = True,
) -> dict[str, float]:
    """By what share of itself a photo's squared error falls on pixels that did not decide, if a field that stays as it is may
    be seen by corrected cameras ("poses") and in corrected light ("light"), each with or without the other, or in light by the
    stated exposures alone ("stated"): the median over photos, since a few in which something moved say nothing of the others.

    Args:
        render: of the field.
        views: the training photos.
        behind: the colour behind the scene.
        corrections: those that there are already; they are not changed.
        generator: of the pixels.
        light: whether to ask about light too; poses alone take less time.
    """
    chosen = subsample(len(views), PHOTOS)
    deciding, judging = (draw_pixels(views, chosen, PIXELS, behind, generator) for _ in range(2))
    left, jacobian = derivatives(render, corrections, deciding, len(chosen))

    def errors(motions: Tensor | None, log_gains: Tensor | None) -> Float[Tensor, "V"]:
        trial = apply_changes(corrections, chosen, motions, log_gains)
        seen = given if motions is None else render_pixels(render, trial, judging)
        return squared_errors(seen, trial, judging, len(chosen))

    given = render_pixels(render, corrections, judging)
    as_it_is = errors(None, None)
    only_poses = errors(least_squares(left, jacobian[..., POSES]), None)
    fallen = {"poses": as_it_is - only_poses}
    if light:
        both = least_squares(left, jacobian)
        corrected = errors(both[:, POSES], both[:, LIGHT])
        only_light = errors(None, least_squares(left, jacobian[..., LIGHT]))
        fallen = {
            "poses": torch.minimum(as_it_is, only_light) - torch.minimum(only_poses, corrected),
            "light": torch.minimum(as_it_is, only_poses) - torch.minimum(only_light, corrected),
            "stated": as_it_is - errors(None, corrections.color.stated[chosen]),
        }
    shares = {name: by / as_it_is for name, by in fallen.items()}  # nan where all is masked
    return {name: float(share.nanmedian().nan_to_num()) for name, share in shares.items()}


def frozen_render(system: "NeRF3D") -> RenderFn:
    """Renders without randomness and with gradient in the rays alone: the field does not learn from it."""
    field, renderer = copy.deepcopy(system.field).requires_grad_(False), copy.deepcopy(system.renderer).eval()

    def render(rays: Rays, behind: Tensor) -> RenderOutput:
        with torch.no_grad():
            samples = system.sampler(rays.detach(), field.density)
        return renderer(rays, samples, field, behind)

    return render


def list_candidates(corrections: Corrections, step: int, progress: float) -> list[str]:
    """What a trial at this step is to decide on; none where no trial is due."""
    doublings, rest = divmod(step, FIRST_TRIAL_STEP)
    is_time = step > 0 and not rest and not doublings & (doublings - 1) and progress <= MAX_TRIAL_PROGRESS
    if not corrections.auto or not is_time:
        return []
    tried = corrections.rates if step >= EARLY_STEPS else corrections.rates.keys() - {"light"}
    return [name for name in tried if name not in corrections.enabled_at]


def choose(candidates: Sequence[str], step: int, gains: dict[str, float], share: float = 1.0) -> list[str]:
    """What helps by a trial at this step that said this; or might, as it explains this share of what it has to."""
    factor = share * (EARLY_FACTOR if step < EARLY_STEPS else 1)
    return [name for name in candidates if gains[name] > factor * MIN_GAIN[name]]


class TryCorrections(L.Callback):
    """Corrects cameras and light from the first trial on that shows that it helps; where it might, more pixels are asked."""

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: "NeRF3D", batch: Any, batch_idx: int) -> None:
        corrections, step, progress = pl_module.corrections, trainer.global_step, pl_module.state.progress
        if corrections is None or not (candidates := list_candidates(corrections, step, progress)):
            return
        views = pl_module.data.scene.train.to(pl_module.device)
        generator = step_generator(pl_module.seed, Stream.TRIAL, step, pl_module.device)
        behind, light = pl_module.renderer.background.color, "light" in candidates
        measure = partial(measure_gains, frozen_render(pl_module), views, behind, corrections, generator, light)
        gains = measure()
        if choose(candidates, step, gains, UNSURE_SHARE):
            several = [gains, *(measure() for _ in range(DRAWS - 1))]
            gains = {name: fmean(one[name] for one in several) for name in gains}
        chosen = choose(candidates, step, gains)
        corrections.decide(progress, chosen, {name: gains[name] for name in candidates}, gains.get("stated", 0.0) > 0)
