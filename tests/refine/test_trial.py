"""Trials of corrections: what they say of photos of a known field, and what follows from it in training."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerf_lightning.cameras import Cameras, Rays
from nerf_lightning.dataset import Views
from nerf_lightning.refine import Corrections
from nerf_lightning.refine.color_correction import GAMMA
from nerf_lightning.refine.corrections import FAST_FACTOR, LR_FINAL_FACTOR, START
from nerf_lightning.renderer import RenderOutput, VolumeRenderer
from nerf_lightning.sampler import UniformSampler
from nerf_lightning.system import misfits
from nerf_lightning.system.trial import (
    EARLY_STEPS,
    FIRST_TRIAL_STEP,
    MAX_TRIAL_PROGRESS,
    MIN_GAIN,
    choose,
    least_squares,
    list_candidates,
    measure_gains,
)
from tests.helpers.soft_ball import BOX, cameras_around_ball, soft_ball

VIEWS, SIZE = 6, 24
BLACK = torch.zeros(3)


def see(rays: Rays, behind: Tensor) -> RenderOutput:
    samples = UniformSampler(BOX, 48)(rays.detach(), lambda x: x[:, 0])
    return VolumeRenderer("black")(rays, samples, soft_ball, behind)


@pytest.fixture
def views() -> Views:
    """Photos of the blob."""
    cameras = cameras_around_ball(VIEWS, SIZE)
    with torch.no_grad():
        rays = [cameras.view_rays(view) for view in range(VIEWS)]
        photos = torch.stack([see(of, BLACK.expand(len(of), 3)).rgb.view(SIZE, SIZE, 3) for of in rays])
    return Views.of((photos * 255).round().to(torch.uint8), cameras)


def spoilt(images: Tensor, pixels: int, some: slice = slice(None)) -> Tensor:
    """Some photos are shifted to one side, and every other of these to the other."""
    images = images.clone()
    for number, view in enumerate(range(VIEWS)[some]):
        images[view] = images[view].roll(pixels * (-1) ** number, dims=1)
    return images


def tried(views: Views, given: Cameras | None = None) -> dict[str, float]:
    """What a trial says of these photos, by cameras that may be others than took them."""
    views = replace(views, cameras=given or views.cameras)
    corrections = Corrections(views.cameras, BOX, auto=True)
    before = [p.clone() for p in corrections.parameters()]
    found = measure_gains(see, views, BLACK, corrections, torch.Generator().manual_seed(1))
    torch.testing.assert_close(list(corrections.parameters()), before)
    return found


def test_trial_names_what_is_wrong_with_photos(views: Views):
    wrong = Corrections(views.cameras, BOX)
    torch.nn.init.normal_(wrong.poses.motions, std=0.5)
    assert max(tried(views, wrong.poses.refine_cameras(views.cameras)).values()) > 0.5
    assert tried(views, wrong.poses.refine_cameras(views.cameras))["light"] < 0.1
    gains = torch.linspace(0.7, 1.3, VIEWS)[:, None, None, None]
    lit = Views.of((views.images * gains).clamp(0, 255).round().to(torch.uint8), views.cameras)
    assert tried(lit)["light"] > 0.5 and tried(lit)["poses"] < 0.1
    noise = torch.randint(-20, 21, views.images.shape)
    noisy = Views.of((views.images + noise).clamp(0, 255).to(torch.uint8), views.cameras)
    assert max(tried(noisy).values()) < 0.02  # what is left to explain is not theirs


def test_trial_masked_pixels_do_not_count(views: Views):
    """Half of every photo is spoilt, and masked."""
    images, mask = views.images.clone(), torch.ones(VIEWS, SIZE, SIZE, dtype=torch.bool)
    images[:, :, SIZE // 2 :] = spoilt(images, 3)[:, :, SIZE // 2 :]
    mask[:, :, SIZE // 2 :] = False
    half = Views.of(images, views.cameras)
    assert tried(half)["poses"] > 0.1
    assert tried(replace(half, known=mask.flatten()))["poses"] < 0.02


def test_trial_few_misfit_photos_say_nothing_of_others(views: Views):
    """Two of six are shifted, far more than all others' noise."""
    images = (views.images + torch.randint(-3, 4, views.images.shape)).clamp(0, 255).to(torch.uint8)
    assert tried(Views.of(spoilt(images, 2), views.cameras))["poses"] > 0.1
    assert tried(Views.of(spoilt(images, 2, slice(1, None, 3)), views.cameras))["poses"] < 0.01


def test_least_squares_is_damped():
    jacobian = torch.randn(2, 50, 3)
    jacobian[:, :, 2] = 0
    truth = torch.tensor([[1.0, -2.0, 5.0], [0.5, 3.0, 5.0]])
    found = least_squares(jacobian @ truth[..., None], jacobian)
    torch.testing.assert_close(found[:, :2], truth[:, :2], rtol=0.3, atol=0.3)
    assert not found[:, 2].any()


def test_trials_come_at_doubled_steps_and_gains_later(views: Views):
    both, light = (Corrections(views.cameras, BOX, poses=poses, auto=True) for poses in (True, False))
    steps = [FIRST_TRIAL_STEP * factor for factor in (1, 2, 4, 8)]
    assert [step for step in range(200) if list_candidates(both, step, START)] == steps
    assert [step for step in range(200) if list_candidates(light, step, START)] == steps[2:]
    assert not list_candidates(both, steps[0], MAX_TRIAL_PROGRESS + 0.01), "too late"
    assert list_candidates(both, steps[0], START) == ["poses"] and steps[2] > EARLY_STEPS
    assert list_candidates(both, steps[2], START) == ["poses", "light"]
    enough = {"poses": 1.5 * MIN_GAIN["poses"], "light": 0.0}
    assert choose(["poses"], steps[0], enough) == [] and choose(["poses", "light"], steps[2], enough) == ["poses"]
    assert choose(["poses"], steps[0], enough, 0.5) == ["poses"] and choose(["poses"], steps[0], enough, 0.8) == []


def test_decided_corrections_are_learned_and_resumed(views: Views):
    corrections, again = (Corrections(views.cameras, BOX, auto=True) for _ in range(2))
    assert set(corrections.lr_factors(1.0).values()) == {0.0} and not corrections.enabled_at
    corrections.decide(START, ["poses"], {"poses": 0.3}, False)
    assert not list_candidates(corrections, FIRST_TRIAL_STEP, START)
    again.load_trial_state(corrections.trial_state())
    for one in (corrections, again):
        assert one.poses.motions.requires_grad and not one.color.log_gains.requires_grad
        assert not any(one.lr_factors(START - 0.001).values())
        assert one.lr_factors(START) == {"poses": FAST_FACTOR, "light": 0.0}
        assert one.lr_factors(1.0) == {"poses": LR_FINAL_FACTOR, "light": 0.0}


def test_gains_start_from_exposures_that_explain_photos(views: Views):
    exposures = [2.0**view for view in range(VIEWS)]
    gains = torch.tensor(exposures).log() / GAMMA
    gains = (gains - gains.mean())[:, None].expand(VIEWS, 3)
    lit = Views.of((views.images * gains.exp()[:, :1, None, None] / 4).clamp(0, 255).to(torch.uint8), views.cameras)
    for photos, brightness, fits in ((lit, 0.25, True), (views, 1.0, False)):

        def darker(rays: Rays, behind: Tensor, brightness: float = brightness) -> RenderOutput:
            return replace(seen := see(rays, behind), rgb=seen.rgb * brightness)

        corrections = Corrections(views.cameras, BOX, exposures=exposures, auto=True)
        found = measure_gains(darker, photos, BLACK, corrections, torch.Generator().manual_seed(1))
        assert (found["stated"] > 0.5) == fits
        corrections.decide(START, ["light"], {"light": 1.0}, found["stated"] > 0)
        torch.testing.assert_close(corrections.color.log_gains.data, gains * fits)
    assert torch.equal(
        Corrections(views.cameras, BOX, exposures=exposures).color.log_gains.data, corrections.color.stated
    )
    assert not Corrections(views.cameras, BOX, exposures=exposures, light=False).color.log_gains.any()


def test_misfits_far_worse_photos_stand_out():
    assert misfits([30.0, 31.0, 29.0, 30.5, 12.0, 30.2, 14.0]) == [4, 6]
    assert misfits([30.0, 20.0, 25.0, 15.0, 28.0]) == []
    assert misfits([float("nan"), 30.0, 30.1, 29.9, 3.0]) == [4]
