"""Corrections as they act on rays and colors, their gradients through every field, and a run with them."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import nerf_lightning as nl
from nerf_lightning.cameras import Cameras, Rays, transform_poses
from nerf_lightning.cli.export import export_transforms
from nerf_lightning.config.compose import compose_config
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import set_kernels
from nerf_lightning.model import Field, HashGridField, MLPField, TensoRFField, VoxelField
from nerf_lightning.refine import Corrections, summarize_corrections
from nerf_lightning.refine.gauge import compute_gauge_modes
from nerf_lightning.renderer import VolumeRenderer
from nerf_lightning.runs.folder import load_config
from nerf_lightning.runs.reload import reload_data
from nerf_lightning.runs.scene_file import read_scene_file
from nerf_lightning.sampler import Samples, UniformSampler
from nerf_lightning.synthetic import corruptions
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.system import photo_quality
from nerf_lightning.system.correction_trial import FIRST_TRIAL_STEP
from nerf_lightning.training.train import train
from tests.helpers.soft_ball import BOX, evaluate_soft_ball, make_ball_cameras

VIEWS, SIZE = 5, 12
"""Photos, and pixels along a side of each."""
STEPS = 300
OFF = ("callbacks.orbit=null", "callbacks.snapshots=null", "callbacks.validation=null", "~logger")
"""Callbacks whose files are not tested here."""


def correct_all(cameras: Cameras) -> Corrections:
    """All corrections."""
    return Corrections(cameras, BOX, focal=True, affine=True, vignetting=True)


@pytest.fixture
def cameras() -> Cameras:
    """Around the box, looking at its center."""
    return make_ball_cameras(VIEWS, SIZE)


def random_pixels(count: int) -> tuple[Tensor, Tensor, Tensor]:
    return torch.randint(0, VIEWS, (count,)), torch.randint(0, SIZE, (count,)), torch.randint(0, SIZE, (count,))


def test_corrections_initial_values_are_identity(cameras: Cameras):
    corrections = Corrections(cameras, BOX)
    rays, (views, *_) = cameras.generate_rays(*(pixels := random_pixels(50))), pixels
    same = corrections.poses(rays, views)
    torch.testing.assert_close((same.origins, same.directions), (rays.origins, rays.directions))
    torch.nn.init.normal_(corrections.poses.pose_adjustment), torch.nn.init.normal_(corrections.color.log_gains)
    before = corrections.poses.refine_cameras(cameras).c2w
    together = compute_gauge_modes(cameras.centers, BOX.center) @ torch.randn(10)
    corrections.poses.pose_adjustment.data += torch.linalg.solve(corrections.poses.preconditioner, together)
    torch.testing.assert_close(corrections.poses.refine_cameras(cameras).c2w, before, atol=1e-4, rtol=0)
    torch.testing.assert_close(corrections.color.gains.log().mean(0), torch.zeros(3), atol=1e-6, rtol=0)


def test_pose_refinement_rays_match_refined_cameras(cameras: Cameras):
    corrections = correct_all(cameras)
    torch.nn.init.normal_(corrections.poses.pose_adjustment, std=2)
    corrections.poses.log_focal.data -= 1
    pixels = random_pixels(50)
    found = corrections.poses(cameras.generate_rays(*pixels), pixels[0])
    expected = corrections.poses.refine_cameras(cameras).generate_rays(*pixels)
    torch.testing.assert_close(found.origins, expected.origins)
    torch.testing.assert_close(found.directions, expected.directions, atol=1e-5, rtol=0)


def test_color_correction_gains_keep_background(cameras: Cameras):
    corrections, views = Corrections(cameras, BOX, poses=False), torch.arange(VIEWS)
    torch.nn.init.normal_(corrections.color.log_gains)
    background, opacity = torch.rand(VIEWS, 3), torch.tensor([0, 0.5, 1, 1, 1])
    red, given = torch.tensor([0.5, 0, 0]).expand(VIEWS, 3), cameras.generate_rays(views, views, views)
    red, behind = opacity[:, None] * red, (1 - opacity)[:, None] * background
    found = corrections.color(red + behind, opacity, background, given, views)
    torch.testing.assert_close(found, red * corrections.color.gains + behind)


def fit_corrections(corrections: Corrections, truth: Corrections, cameras: Cameras) -> None:
    """Trains corrections on photos of a known ball, with the true corrections `truth`."""
    sampler, renderer, background = UniformSampler(BOX, 32), VolumeRenderer("black"), torch.zeros(200, 3)

    def seen(by: Corrections, pixels: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        rays = by.poses(given := cameras.generate_rays(*pixels), pixels[0])
        found = renderer(rays, sampler(rays.detach(), lambda x: x[:, 0]), evaluate_soft_ball)
        return by.color(found.rgb, found.opacity, background, given, pixels[0])

    optimizer = torch.optim.Adam(corrections.param_groups())
    for step in range(STEPS):
        for group, rate in zip(optimizer.param_groups, (0.1, 0.02), strict=True):
            group["lr"] = rate * 0.02 ** (step / STEPS)
        pixels = random_pixels(200)
        optimizer.zero_grad()
        (seen(corrections, pixels) - seen(truth, pixels).detach()).square().mean().backward()
        optimizer.step()


def test_corrections_known_field_recover_poses_and_gains(cameras: Cameras):
    """Photos from misplaced cameras, with varying exposure."""
    truth, corrections = Corrections(cameras, BOX), Corrections(cameras, BOX)
    torch.nn.init.normal_(truth.poses.pose_adjustment, std=0.5), torch.nn.init.normal_(truth.color.log_gains, std=0.1)
    fit_corrections(corrections, truth, cameras)
    before, after = (
        by.poses.refine_cameras(cameras).c2w - truth.poses.refine_cameras(cameras).c2w
        for by in (Corrections(cameras, BOX), corrections)
    )
    assert float(after.norm()) < 0.15 * float(before.norm())
    left, wrong = (
        float((by.color.gains - truth.color.gains).abs().max().detach())
        for by in (corrections, Corrections(cameras, BOX))
    )
    assert left < 0.2 * wrong


def test_corrections_known_field_recover_lens_and_colors(cameras: Cameras):
    truth, corrections = correct_all(cameras), correct_all(cameras)
    truth.poses.log_focal.data += 0.5
    truth.color.vignetting_coefficients.data += 0.4
    torch.nn.init.normal_(truth.color.color_matrices, std=0.1)
    fit_corrections(corrections, truth, cameras)
    wrong = correct_all(cameras)
    for name in ("focal_factor", "corner_brightness"):
        found, before, right = (summarize_corrections(by)[name] for by in (corrections, wrong, truth))
        assert abs(found - right) < 0.3 * abs(before - right)
    # A photo's gains are the diagonal of how it mixes colors.
    found, meant, none = (
        by.color.color_matrices[:, :, :3] + torch.diag_embed(by.color.gains) for by in (corrections, truth, wrong)
    )
    mean = (found - meant).mean(0)
    assert bool((found - meant - mean).norm() < 0.4 * (none - meant).norm())


def test_compute_vignetting_darkens_corners_only():
    K = torch.tensor([[60.0, 0, 50], [0, 60, 40], [0, 0, 1]])
    camera = Cameras.pinhole(K[None], torch.eye(4)[None], 100, 80)
    lens = correct_all(camera).color
    lens.vignetting_coefficients.data = torch.tensor([0.3, 0.2])
    ends = torch.tensor([[0.0, 0, 1], [50 / 60, 40 / 60, 1]])
    found = lens.compute_vignetting(torch.nn.functional.normalize(ends, dim=1), torch.zeros(2, dtype=torch.long))
    torch.testing.assert_close(found[:, 0], torch.tensor([1.0, float(lens.corner_brightness.detach())]))


FIELDS = {
    "hashgrid": lambda: HashGridField(BOX, 3, log2_hashmap_size=8, base_resolution=4, max_resolution=16, width=16),
    "tensorf": lambda: TensoRFField(BOX, 8, 8, base_resolution=6, max_resolution=6, stages=1, width=16),
    "voxels": lambda: VoxelField(BOX, base_resolution=6, max_resolution=6, stages=1),
    "mlp": lambda: MLPField(BOX, width=16),
}


def loss(field: Field, corrections: Corrections, rays: Rays, views: Tensor, samples: Samples, direction) -> Tensor:
    """Sum over the rendered samples, with directions that do not follow the cameras."""
    seen = VolumeRenderer("black").to(direction.device, direction.dtype)(
        corrections.poses(rays, views), samples, lambda x, _: field(x, samples.directions(rays))
    )
    return (corrections.color(seen.rgb, seen.opacity, torch.zeros_like(direction), rays, views) * direction).sum()


@pytest.mark.parametrize("name", FIELDS)
def test_corrections_gradients_match_finite_differences(name: str, cameras: Cameras):
    """Against differences in double precision; then those of the fast version against those of the reference."""
    pixels, direction = random_pixels(40), torch.randn(40, 3)
    given, views, field, corrections = cameras.generate_rays(*pixels), pixels[0], FIELDS[name](), correct_all(cameras)
    for parameter in field.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    for parameter in corrections.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    samples, parameters = UniformSampler(BOX, 12)(given, lambda x: x[:, 0]), list(corrections.parameters())
    by = {}
    for choice in ("auto", "reference"):
        set_kernels(choice)
        by[choice] = torch.autograd.grad(loss(field, corrections, given, views, samples, direction), parameters)
    for fast, plain in zip(by["auto"], by["reference"], strict=True):
        assert float(plain.norm()) > 1e-3
        torch.testing.assert_close(fast, plain, rtol=1e-3, atol=1e-4 * float(plain.abs().max()))

    field, corrections = field.double(), corrections.double()
    double = replace(samples, t=samples.t.double(), dt=samples.dt.double(), cached_positions=None)
    rest = Rays(given.origins.double(), given.directions.double()), views, double, direction.double()
    for parameter in corrections.parameters():
        (slope,) = torch.autograd.grad(loss(field, corrections, *rest), parameter)
        direction_of_change, step = torch.randn_like(slope), 1e-7
        ends = []
        with torch.no_grad():
            for side in (step, -2 * step, step):
                parameter += side * direction_of_change
                ends.append(float(loss(field, corrections, *rest)))
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float((slope * direction_of_change).sum()), rel=1e-3)


def test_train_with_corrections_reports_and_exports_poses(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr(photo_quality, "ALIGN_PIXELS", 64)
    monkeypatch.setattr(photo_quality, "SCORED_PIXELS", 512)
    few = ["dataset.size=16", "dataset.train_views=4", "dataset.val_views=1", "dataset.rays=64", "budget.steps=12"]
    train(compose_config(["+experiment=smoke_3d", "refine=both", *few, *OFF], tmp_path))
    assert "refine: cameras turned by up to" in capsys.readouterr().out
    found = json.loads((tmp_path / "results.json").read_text())["corrections"]
    assert [len(found[key]) for key in ("turned_degrees", "moved", "exposure")] == [4, 4, 4]
    assert found["focal_factor"] is None and found["corner_brightness"] is None
    assert max(found["turned_degrees"]) > 0 and min(found["exposure"]) < 1 < max(found["exposure"])
    assert nl.load_run(tmp_path, "cpu").system.corrections is None
    files = load_config(tmp_path), read_scene_file(tmp_path)
    again = [reload_data(*files, corrected=which).scene for which in (True, False)]
    moved, given = ([poses.train.cameras.centers for poses in again][i] for i in (0, 1))
    torch.testing.assert_close((moved - given).norm(dim=1), torch.tensor(found["moved"]), atol=2e-5, rtol=0)
    assert found["moved"][0] > 0 and torch.equal(again[0].val.cameras.c2w, again[1].val.cameras.c2w)
    export_transforms(tmp_path)
    assert "5 photos and transforms.json, cameras as corrected" in capsys.readouterr().out
    written = nl.load_scene(tmp_path / "posed")
    for found, expected_views in ((written.train, again[0].train), (written.val, again[0].val)):
        torch.testing.assert_close(
            transform_poses(found.cameras.c2w, written.to_source),
            transform_poses(expected_views.cameras.c2w, again[0].to_source),
        )
        assert torch.equal(found.pixels, expected_views.pixels)
    with pytest.raises(InputError, match="posed: exists already; give another"):
        export_transforms(tmp_path)
    with pytest.raises(InputError, match=r"corrected: found shape"):
        reload_data(load_config(tmp_path), {**read_scene_file(tmp_path), "corrected": [1.0]})


def test_refine_auto_bad_silhouettes_enable_poses(tmp_path: Path):
    size = {"size": 16, "train_views": 12, "val_views": 1}
    options = ["+experiment=smoke_3d", "refine=auto", "dataset.rays=64", f"budget.steps={FIRST_TRIAL_STEP - 1}", *OFF]
    for scene, wanted in ((bricks(**size), False), (corruptions.add_pose_noise(bricks(**size), 0, 15.0, 0.1), True)):
        folder = tmp_path / str(wanted)
        train(compose_config(options, folder), folder=folder, scene=scene)
        results = json.loads((folder / "results.json").read_text())
        assert any("inconsistent silhouettes" in warning for warning in results["warnings"]) == wanted
        assert any(results["corrections"]["turned_degrees"]) == wanted


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"poses": False, "exposure": False}, "refine.poses"),
        ({"poses": False, "focal": True}, "refine.focal.*refine.poses=false.*give refine.poses=true"),
        ({"exposure": False, "affine": True}, "refine.affine.*refine.exposure=false"),
    ],
)
def test_corrections_without_effect_raise(options: dict, key: str, cameras: Cameras):
    with pytest.raises(InputError, match=key):
        Corrections(cameras, BOX, **options)
