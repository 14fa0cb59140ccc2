"""Pose and exposure errors: what each method loses by them, and how much `refine` regains."""

import argparse
import itertools
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

import nerf_lightning as nl
from benchmarks.tables import Rows, compute_medians
from nerf_lightning.cameras import Cameras, transform_poses
from nerf_lightning.capture.poses.geometry import angle_between
from nerf_lightning.dataset import Scene
from nerf_lightning.runs.reload import apply_refined_cameras
from nerf_lightning.runs.scene_file import read_scene_file
from nerf_lightning.synthetic import corruptions
from nerf_lightning.synthetic.bricks import bricks

RECIPES = ("tensorf_medium", "voxels_medium", "hashgrid_medium")
STEPS = 2500
"""Steps of every training, about a minute on two cores; independent of machine load, unlike seconds."""
FEW_PHOTOS, WRONG_POSES = 12, 3
"""Number of photos in the conditions with few, and number of swapped poses."""
Corruption = Callable[[Scene, int], Scene]


def vary_exposure(scene: Scene, seed: int) -> Scene:
    return corruptions.vary_exposure(scene, seed, 0.3, 0.1)


def darken_corners(scene: Scene, seed: int) -> Scene:
    return corruptions.add_vignetting(vary_exposure(scene, seed), seed, 0.5)


def make_pose_noise(degrees: float, shift_std: float) -> Corruption:
    return lambda scene, seed: corruptions.add_pose_noise(scene, seed, degrees, shift_std)


def add_noise_and_exposure(scene: Scene, seed: int) -> Scene:
    return vary_exposure(make_pose_noise(0.5, 0.01)(scene, seed), seed)


CONDITIONS: dict[str, tuple[int | None, Corruption, list[str]]] = {
    "exact": (None, lambda scene, seed: scene, []),
    "0.5 degrees, 1 %": (None, make_pose_noise(0.5, 0.01), []),
    "2 degrees, 3 %": (None, make_pose_noise(2.0, 0.03), []),
    "5 degrees, 5 %": (None, make_pose_noise(5.0, 0.05), []),
    "light": (None, vary_exposure, []),
    "light, dark corners": (None, darken_corners, ["refine.vignetting=true"]),
    "focal length 3 % too long": (None, lambda s, n: corruptions.scale_focal_length(s, n, 1.03), ["refine.focal=true"]),
    "both, 3 wrong": (None, lambda s, n: corruptions.swap_poses(add_noise_and_exposure(s, n), n, WRONG_POSES), []),
    "exact, 12 photos": (FEW_PHOTOS, lambda scene, seed: scene, []),
    "both, 12 photos": (FEW_PHOTOS, add_noise_and_exposure, []),
}
"""Number of photos (None for all), the corruption, and additional options for the refined run."""


def fit_similarity(points: Float[Tensor, "V 3"], truth: Float[Tensor, "V 3"]) -> Float[Tensor, "4 4"]:
    """Least-squares similarity that aligns points with others (Umeyama 1991, eq. 40 to 43)."""
    mean, target = points.mean(0), truth.mean(0)
    left, values, right = torch.linalg.svd((truth - target).mT @ (points - mean))
    signs = torch.ones(3, dtype=points.dtype)
    signs[2] = torch.linalg.det(left @ right).sign()
    matrix = torch.eye(4, dtype=points.dtype)
    matrix[:3, :3] = (values * signs).sum() / (points - mean).square().sum() * (left @ torch.diag(signs) @ right)
    matrix[:3, 3] = target - matrix[:3, :3] @ mean
    return matrix


def measure_camera_errors(cameras: Cameras, truth: Cameras, center: Float[Tensor, "3"]) -> dict[str, float]:
    """Mean rotation error in degrees and mean position error in percent of the distance to the content, after alignment by
    a similarity, which a field cannot observe."""
    true_poses = truth.c2w.double()
    aligned = transform_poses(cameras.c2w, fit_similarity(cameras.c2w[:, :3, 3].double(), true_poses[:, :3, 3]))
    angles = [angle_between(a, b) for a, b in zip(aligned.numpy(), true_poses.numpy(), strict=True)]
    shift = (aligned - true_poses)[:, :3, 3].norm(dim=1)
    distance = (true_poses[:, :3, 3] - center.double()).norm(dim=1)
    return {"degrees": math.degrees(fmean(angles)), "moved_percent": 100 * float((shift / distance).mean())}


def measure(args: argparse.Namespace) -> Rows:
    """Measures each scene, condition and recipe, without and with `refine=auto`; rows are medians over seeds."""
    rows: Rows = []
    for whole in [nl.load_scene(path) for path in args.scenes] or [bricks()]:
        for condition, recipe, refine in itertools.product(CONDITIONS, args.recipes or RECIPES, ("none", "auto")):
            views, corrupt, extra_options = CONDITIONS[condition]
            truth = whole if views is None else corruptions.subsample_views(whole, 0, views)
            runs = []
            for seed in args.seeds:
                print(f"camera_noise: {whole.name}, {condition}, {recipe}, refine={refine}, seed {seed}", flush=True)
                options = [*([] if refine == "none" else [f"refine={refine}", *extra_options]), *args.overrides]
                scene, folder = corrupt(truth, seed), args.output / "cameras"
                runs.append(train_corrupted(truth, scene, recipe, options, seed, folder))
            labels = {"scene": whole.name, "condition": condition, "recipe": recipe, "refine": refine}
            rows.append(labels | compute_medians(runs))
    return rows


def train_corrupted(
    truth: Scene, corrupted: Scene, recipe: str, options: list[str], seed: int, folder: Path
) -> dict[str, float]:
    """Trains on a corrupted scene; returns PSNR, camera errors, and the number of photos reported as misfits."""
    shutil.rmtree(folder, ignore_errors=True)
    options = [*options, "callbacks.orbit=null", "callbacks.snapshots.steps=[]", "callbacks.validation.fractions=[]"]
    results = nl.train(corrupted, recipe, steps=STEPS, seed=seed, folder=folder, options=options).results
    aligned = results["psnr"] if results["psnr_aligned"] is None else results["psnr_aligned"]
    refined = apply_refined_cameras(corrupted, read_scene_file(folder)).train.cameras
    figures = {"psnr": results["psnr"], "psnr_aligned": aligned, "step_ms": 1000 * results["train_seconds"] / STEPS}
    errors = measure_camera_errors(refined, truth.train.cameras, truth.bounds.center)
    return {**figures, **errors, "misfits": len(results["misfits"])}
