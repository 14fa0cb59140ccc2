"""Correction trials on photos of a known field, and their effect on training."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerf_lightning.cameras import Cameras, Rays
from nerf_lightning.dataset import Views
from nerf_lightning.refine import Corrections
from nerf_lightning.refine.color_correction import GAMMA
from nerf_lightning.refine.corrections import LR_FINAL_FACTOR, POSE_LR_BOOST, START_PROGRESS
from nerf_lightning.renderer import RenderOutput, VolumeRenderer
from nerf_lightning.sampler import UniformSampler
from nerf_lightning.system import find_outlier_photos
from nerf_lightning.system.correction_trial import (
    EARLY_TRIAL_STEPS,
    FIRST_TRIAL_STEP,
    MAX_TRIAL_PROGRESS,
    MIN_ERROR_REDUCTION,
    list_candidates,
    measure_error_reductions,
    select_corrections,
    solve_damped_least_squares,
)
from tests.helpers.soft_ball import BOX, evaluate_soft_ball, make_ball_cameras

VIEWS, SIZE = 6, 24
BLACK = torch.zeros(3)


def render_ball(rays: Rays, background: Tensor) -> RenderOutput:
    samples = UniformSampler(BOX, 48)(rays.detach(), lambda x: x[:, 0])
    return VolumeRenderer("black")(rays, samples, evaluate_soft_ball, background)


@pytest.fixture
def views() -> Views:
    """Photos of the blob."""
    cameras = make_ball_cameras(VIEWS, SIZE)
    with torch.no_grad():
        rays = [cameras.generate_view_rays(view) for view in range(VIEWS)]
        photos = torch.stack([render_ball(of, BLACK.expand(len(of), 3)).rgb.view(SIZE, SIZE, 3) for of in rays])
    return Views.from_images((photos * 255).round().to(torch.uint8), cameras)


def shift_alternately(images: Tensor, pixels: int, some: slice = slice(None)) -> Tensor:
    """Shifts some photos sideways, in alternating directions."""
    images = images.clone()
    for number, view in enumerate(range(VIEWS)[some]):
        images[view] = images[view].roll(pixels * (-1) ** number, dims=1)
    return images


def run_trial(views: Views, given: Cameras | None = None) -> dict[str, float]:
    """Runs a trial on photos, with cameras that may differ from the true ones."""
    views = replace(views, cameras=given or views.cameras)
    corrections = Corrections(views.cameras, BOX, auto=True)
    before = [p.clone() for p in corrections.parameters()]
    found = measure_error_reductions(render_ball, views, BLACK, corrections, torch.Generator().manual_seed(1))
    torch.testing.assert_close(list(corrections.parameters()), before)
    return found


def test_trial_faulty_photos_names_fault(views: Views):
    wrong = Corrections(views.cameras, BOX)
    torch.nn.init.normal_(wrong.poses.pose_adjustment, std=0.5)
    assert max(run_trial(views, wrong.poses.refine_cameras(views.cameras)).values()) > 0.5
    assert run_trial(views, wrong.poses.refine_cameras(views.cameras))["exposure"] < 0.1
    gains = torch.linspace(0.7, 1.3, VIEWS)[:, None, None, None]
    exposed = Views.from_images((views.images * gains).clamp(0, 255).round().to(torch.uint8), views.cameras)
    assert run_trial(exposed)["exposure"] > 0.5 and run_trial(exposed)["poses"] < 0.1
    noise = torch.randint(-20, 21, views.images.shape)
    noisy = Views.from_images((views.images + noise).clamp(0, 255).to(torch.uint8), views.cameras)
    assert max(run_trial(noisy).values()) < 0.02  # noise is no fault of poses or exposure


def test_trial_masked_pixels_are_ignored(views: Views):
    """Half of every photo is spoilt, and masked."""
    images, mask = views.images.clone(), torch.ones(VIEWS, SIZE, SIZE, dtype=torch.bool)
    images[:, :, SIZE // 2 :] = shift_alternately(images, 3)[:, :, SIZE // 2 :]
    mask[:, :, SIZE // 2 :] = False
    half = Views.from_images(images, views.cameras)
    assert run_trial(half)["poses"] > 0.1
    assert run_trial(replace(half, valid_mask=mask.flatten()))["poses"] < 0.02


def test_trial_few_outlier_photos_reports_no_reduction(views: Views):
    """Two of six are shifted, far more than all others' noise."""
    images = (views.images + torch.randint(-3, 4, views.images.shape)).clamp(0, 255).to(torch.uint8)
    assert run_trial(Views.from_images(shift_alternately(images, 2), views.cameras))["poses"] > 0.1
    assert run_trial(Views.from_images(shift_alternately(images, 2, slice(1, None, 3)), views.cameras))["poses"] < 0.01


def test_solve_damped_least_squares_null_column_gives_zero():
    jacobian = torch.randn(2, 50, 3)
    jacobian[:, :, 2] = 0
    truth = torch.tensor([[1.0, -2.0, 5.0], [0.5, 3.0, 5.0]])
    found = solve_damped_least_squares(jacobian @ truth[..., None], jacobian)
    torch.testing.assert_close(found[:, :2], truth[:, :2], rtol=0.3, atol=0.3)
    assert not found[:, 2].any()


def test_list_candidates_steps_double_and_exposure_comes_later(views: Views):
    both, exposure = (Corrections(views.cameras, BOX, poses=poses, auto=True) for poses in (True, False))
    steps = [FIRST_TRIAL_STEP * factor for factor in (1, 2, 4, 8)]
    assert [step for step in range(200) if list_candidates(both, step, START_PROGRESS)] == steps
    assert [step for step in range(200) if list_candidates(exposure, step, START_PROGRESS)] == steps[2:]
    assert not list_candidates(both, steps[0], MAX_TRIAL_PROGRESS + 0.01), "too late"
    assert list_candidates(both, steps[0], START_PROGRESS) == ["poses"] and steps[2] > EARLY_TRIAL_STEPS
    assert list_candidates(both, steps[2], START_PROGRESS) == ["poses", "exposure"]
    enough = {"poses": 1.5 * MIN_ERROR_REDUCTION["poses"], "exposure": 0.0}
    assert select_corrections(["poses"], steps[0], enough) == [] and select_corrections(
        ["poses", "exposure"], steps[2], enough
    ) == ["poses"]
    assert (
        select_corrections(["poses"], steps[0], enough, 0.5) == ["poses"]
        and select_corrections(["poses"], steps[0], enough, 0.8) == []
    )


def test_record_trial_selected_corrections_are_learned_and_resumed(views: Views):
    corrections, again = (Corrections(views.cameras, BOX, auto=True) for _ in range(2))
    assert set(corrections.lr_factors(1.0).values()) == {0.0} and not corrections.enabled_at
    corrections.record_trial(START_PROGRESS, ["poses"], {"poses": 0.3}, False)
    assert not list_candidates(corrections, FIRST_TRIAL_STEP, START_PROGRESS)
    again.load_trial_state(corrections.trial_state())
    for one in (corrections, again):
        assert one.poses.pose_adjustment.requires_grad and not one.color.log_gains.requires_grad
        assert not any(one.lr_factors(START_PROGRESS - 0.001).values())
        assert one.lr_factors(START_PROGRESS) == {"poses": POSE_LR_BOOST, "exposure": 0.0}
        assert one.lr_factors(1.0) == {"poses": LR_FINAL_FACTOR, "exposure": 0.0}


def test_init_from_exif_only_if_exposures_explain_photos(views: Views):
    exposures = [2.0**view for view in range(VIEWS)]
    gains = torch.tensor(exposures).log() / GAMMA
    gains = (gains - gains.mean())[:, None].expand(VIEWS, 3)
    images = (views.images * gains.exp()[:, :1, None, None] / 4).clamp(0, 255).to(torch.uint8)
    exposed = Views.from_images(images, views.cameras)
    for photos, brightness, fits in ((exposed, 0.25, True), (views, 1.0, False)):

        def darker(rays: Rays, background: Tensor, brightness: float = brightness) -> RenderOutput:
            return replace(seen := render_ball(rays, background), foreground=seen.rgb * brightness, backgrounds=None)

        corrections = Corrections(views.cameras, BOX, exposures=exposures, auto=True)
        found = measure_error_reductions(darker, photos, BLACK, corrections, torch.Generator().manual_seed(1))
        assert (found["exif"] > 0.5) == fits
        corrections.record_trial(START_PROGRESS, ["exposure"], {"exposure": 1.0}, found["exif"] > 0)
        torch.testing.assert_close(corrections.color.log_gains.data, gains * fits)
    started = Corrections(views.cameras, BOX, exposures=exposures).color
    assert torch.equal(started.log_gains.data, corrections.color.exif_log_gains)
    assert not Corrections(views.cameras, BOX, exposures=exposures, exposure=False).color.log_gains.any()


def test_find_outlier_photos_far_worse_photos_are_listed():
    assert find_outlier_photos([30.0, 31.0, 29.0, 30.5, 12.0, 30.2, 14.0]) == [4, 6]
    assert find_outlier_photos([30.0, 20.0, 25.0, 15.0, 28.0]) == []
    assert find_outlier_photos([float("nan"), 30.0, 30.1, 29.9, 3.0]) == [4]
