"""Cameras and light that are not exact: what each method loses by them, and how much of it `refine` brings back."""

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
from nerf_lightning.runs.scene_file import read_scene_file as content_of
from nerf_lightning.synthetic import corruptions
from nerf_lightning.synthetic.bricks import bricks

RECIPES = ("tensorf_medium", "voxels_medium", "hashgrid_medium")
STEPS = 2500
"""Of every training, about a minute on two cores: seconds would let a busy machine decide."""
FEW_PHOTOS, WRONG_POSES = 12, 3
"""Photos where there are few, and how many have another one's pose where some are wrong."""
Corruption = Callable[[Scene, int], Scene]


def vary_exposure(scene: Scene, seed: int) -> Scene:
    return corruptions.vary_exposure(scene, seed, 0.3, 0.1)


def make_pose_noise(degrees: float, moved: float) -> Corruption:
    return lambda scene, seed: corruptions.add_pose_noise(scene, seed, degrees, moved)


def add_noise_and_exposure(scene: Scene, seed: int) -> Scene:
    return vary_exposure(make_pose_noise(0.5, 0.01)(scene, seed), seed)


CONDITIONS: dict[str, tuple[int | None, Corruption, list[str]]] = {
    "exact": (None, lambda scene, seed: scene, []),
    "0.5 degrees, 1 %": (None, make_pose_noise(0.5, 0.01), []),
    "2 degrees, 3 %": (None, make_pose_noise(2.0, 0.03), []),
    "5 degrees, 5 %": (None, make_pose_noise(5.0, 0.05), []),
    "light": (None, vary_exposure, []),
    "light, dark corners": (
        None,
        lambda s, n: corruptions.add_vignetting(vary_exposure(s, n), n, 0.5),
        ["refine.vignetting=true"],
    ),
    "focal length 3 % too long": (None, lambda s, n: corruptions.scale_focal_length(s, n, 1.03), ["refine.focal=true"]),
    "both, 3 wrong": (
        None,
        lambda scene, seed: corruptions.swap_poses(add_noise_and_exposure(scene, seed), seed, WRONG_POSES),
        [],
    ),
    "exact, 12 photos": (FEW_PHOTOS, lambda scene, seed: scene, []),
    "both, 12 photos": (FEW_PHOTOS, add_noise_and_exposure, []),
}
"""How many photos there are, None for all, what is done to them, and what is corrected besides."""


def fit_similarity(found: Float[Tensor, "V 3"], truth: Float[Tensor, "V 3"]) -> Float[Tensor, "4 4"]:
    """The turn, scale and shift that bring points closest to others (Umeyama 1991, eq. 40 to 43)."""
    mean, target = found.mean(0), truth.mean(0)
    left, values, right = torch.linalg.svd((truth - target).mT @ (found - mean))
    signs = torch.ones(3, dtype=found.dtype)
    signs[2] = torch.linalg.det(left @ right).sign()
    matrix = torch.eye(4, dtype=found.dtype)
    matrix[:3, :3] = (values * signs).sum() / (found - mean).square().sum() * (left @ torch.diag(signs) @ right)
    matrix[:3, 3] = target - matrix[:3, :3] @ mean
    return matrix


def measure_camera_errors(found: Cameras, truth: Cameras, centre: Float[Tensor, "3"]) -> dict[str, float]:
    """Mean angle in degrees and mean distance in percent of that to the content, between cameras whose common turn, scale and
    shift has been taken off: a field does not know of those."""
    true = truth.c2w.double()
    together = transform_poses(found.c2w, fit_similarity(found.c2w[:, :3, 3].double(), true[:, :3, 3]))
    turned = [angle_between(a, b) for a, b in zip(together.numpy(), true.numpy(), strict=True)]
    apart = (together - true)[:, :3, 3].norm(dim=1)
    distance = (true[:, :3, 3] - centre.double()).norm(dim=1)
    return {"degrees": math.degrees(fmean(turned)), "moved_percent": 100 * float((apart / distance).mean())}


def measure(args: argparse.Namespace) -> Rows:
    """One line for each scene, condition and recipe, without and with `refine=auto`: medians over seeds."""
    rows: Rows = []
    for whole in [nl.load_scene(path) for path in args.scenes] or [bricks()]:
        for condition, recipe, refine in itertools.product(CONDITIONS, args.recipes or RECIPES, ("none", "auto")):
            views, spoil, besides = CONDITIONS[condition]
            truth = whole if views is None else corruptions.subsample_views(whole, 0, views)
            found = []
            for seed in args.seeds:
                print(f"cameras: {whole.name}, {condition}, {recipe}, refine={refine}, seed {seed}", flush=True)
                options = [*([] if refine == "none" else [f"refine={refine}", *besides]), *args.overrides]
                found.append(train_corrupted(truth, spoil(truth, seed), recipe, options, seed, args.output / "cameras"))
            about = {"scene": whole.name, "condition": condition, "recipe": recipe, "refine": refine}
            rows.append(about | compute_medians(found))
    return rows


def train_corrupted(
    truth: Scene, spoilt: Scene, recipe: str, options: list[str], seed: int, folder: Path
) -> dict[str, float]:
    """The figures of one training on a spoilt scene: dB, the cameras' errors, and how many photos were named as unfit."""
    shutil.rmtree(folder, ignore_errors=True)
    options = [*options, "callbacks.orbit=null", "callbacks.snapshots.steps=[]", "callbacks.validation.fractions=[]"]
    results = nl.train(spoilt, recipe, steps=STEPS, seed=seed, folder=folder, options=options).results
    aligned = results["psnr"] if results["psnr_aligned"] is None else results["psnr_aligned"]
    found = apply_refined_cameras(spoilt, content_of(folder)).train.cameras
    figures = {
        "psnr": results["psnr"],
        "psnr_aligned": aligned,
        "milliseconds_a_step": 1000 * results["train_seconds"] / STEPS,
    }
    return (
        figures
        | measure_camera_errors(found, truth.train.cameras, truth.bounds.centre)
        | {"named": len(results["misfits"])}
    )
