"""Held-out photos whose own cameras and light are corrected too: half of a photo decides, the other half is scored."""

import torch
from jaxtyping import Int
from torch import Tensor

from nerf_lightning.dataset import Views
from nerf_lightning.dataset.rays import rays_through
from nerf_lightning.refine import Corrections
from nerf_lightning.renderer import over
from nerf_lightning.system.metrics import mse_to_psnr
from nerf_lightning.system.nerf3d import NeRF3D
from nerf_lightning.utils.progress import tracked
from nerf_lightning.utils.seeding import Stream, step_generator

STEPS, RAYS = 200, 2048
"""In which the corrections of all held-out photos are found, and rays in each."""


def halves(views: Views, view: int) -> tuple[Int[Tensor, "L"], Int[Tensor, "R"]]:
    """The places in `Views.pixels` of the known pixels in a photo's left and right half."""
    known = views.mask_of(view)
    left = torch.arange(known.shape[1], device=known.device) < known.shape[1] // 2
    start = int(views.starts[view])
    first, second = (start + (known & side).flatten().nonzero()[:, 0] for side in (left, ~left))
    return first, second


def fitted(system: NeRF3D, views: Views, places: Int[Tensor, "P"], corrections: Corrections) -> None:
    """Finds corrections with which a field, that stays as it is, fits these pixels best."""
    see, optimizer = system.as_it_is(), torch.optim.Adam(corrections.groups, betas=(0.9, 0.99))
    started = [group["lr"] for group in optimizer.param_groups]
    generator = step_generator(system.seed, Stream.STUDY, 1, system.device)
    for step in tracked(range(STEPS), STEPS, "aligning held-out photos"):
        for group, rate in zip(optimizer.param_groups, started, strict=True):
            group["lr"] = rate * corrections.FINAL ** (step / STEPS)
        some = places[torch.randint(len(places), (RAYS,), generator=generator, device=places.device)]
        given, view = rays_through(views, some)
        behind = system.renderer.backgrounds(RAYS)
        seen = see(corrections.rays(given, view), behind)
        truth = over(views.pixels[some], behind)
        rgb = corrections.lit(seen.rgb, seen.opacity, behind, given, view, truth)
        optimizer.zero_grad()
        torch.nn.functional.mse_loss(rgb, truth).backward()
        optimizer.step()


@torch.inference_mode(False)  # a trainer's test is without gradients
@torch.enable_grad()
def aligned_psnr(system: NeRF3D, views: Views) -> list[float]:
    """PSNR of each held-out photo in dB, by a camera and gains that were found on the half that is not scored.

    Cameras that were corrected may together stand a little apart from where held-out ones are said to be: this figure asks
    how good the field is, and not whether both agree.
    """
    assert system.corrections is not None  # else there is nothing to align
    views = views.to(system.device)
    parts = [halves(views, view) for view in range(len(views))]
    squares, counts = torch.zeros(len(views), dtype=torch.float64), torch.zeros(len(views))
    for side in (0, 1):
        corrections = system.corrections.alike(views.cameras, system.sampler.bounds).to(system.device)
        fitted(system, views, torch.cat([part[side] for part in parts]), corrections)
        with torch.no_grad():
            for view, part in enumerate(parts):
                given, of = rays_through(views, part[1 - side])
                seen, behind = system.render(corrections.rays(given, of)), system.renderer.backgrounds(len(of))
                rgb = corrections.lit(seen.rgb, seen.opacity, behind, given, of).clamp(0, 1)
                squares[view] += float((rgb - over(views.pixels[part[1 - side]], behind)).square().sum())
                counts[view] += rgb.numel()
    return [mse_to_psnr(mse) for mse in (squares / counts.clamp_min(1)).tolist()]
