"""Marks as a camera would see them: exact projections of known tags, with noise if wanted."""

from pathlib import Path

import numpy as np
import torch

from nerf_lightning.cameras import Distortion, look_at
from nerf_lightning.capture.poses.geometry import invert_pose, project_points
from nerf_lightning.capture.tags.detect import PhotoObservation, TagDetection
from nerf_lightning.capture.tags.tag_layout import UNIT_SQUARE, TagLayout, flat_pose
from nerf_lightning.dataset.intrinsics import Intrinsics

TAG_SIZE = 0.06
LENS = Intrinsics(1024, 768, 900.0, 900.0, 520.0, 380.0, Distortion(k1=-0.2, k2=0.05))
SMALL_LENS = Intrinsics(400, 300, 350.0, 350.0, 203.0, 148.0, Distortion(k1=-0.1, k2=0.02))
TAG_POSES = {3 * r + c: flat_pose(0.09 * c, -0.09 * r) for r in (0, 1) for c in (0, 1, 2)}
SIX_TAGS = TagLayout("DICT_4X4_50", TAG_SIZE, TAG_POSES)
ONE_TAG = TagLayout("DICT_4X4_50", TAG_SIZE, {0: flat_pose(0.0, 0.0)})


def make_pose(eye: list[float] | np.ndarray, target: list[float] | np.ndarray, roll: float = 0.0) -> np.ndarray:
    """Camera to world, looking from one point at another; `roll` in radians."""
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    c2w = look_at(torch.tensor(np.array(eye, float)), torch.tensor(np.array(target, float)), up).numpy()
    c, s = np.cos(roll), np.sin(roll)
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return c2w @ turn


def make_poses(count: int, seed: int = 0, tilt: float = 40.0, distance: float = 0.4) -> np.ndarray:
    """Camera to world, looking at the sheet from angles up to `tilt` degrees off its normal."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        polar, azimuth = np.radians(tilt) * np.sqrt(rng.random()), 2 * np.pi * rng.random()
        target = np.array([0.09, -0.045, 0]) + 0.03 * rng.standard_normal(3) * [1, 1, 0]
        way = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
        out.append(make_pose(target + distance * (0.8 + 0.5 * rng.random()) * way, target, 0.5 * rng.standard_normal()))
    return np.stack(out)


def make_observations(
    layout: TagLayout, c2w: np.ndarray, lens: Intrinsics = LENS, noise: float = 0.1, seed: int = 0, folder=Path("x")
) -> list[PhotoObservation]:
    """What photos from these cameras show of a layout, without the tags that are not wholly in the frame."""
    rng, observations = np.random.default_rng(seed), []
    for i, pose in enumerate(c2w):
        detections = {}
        for tag in layout.poses:
            pixels = project_points(lens, invert_pose(pose), layout.corners(tag)) + noise * rng.standard_normal((4, 2))
            if (pixels > 4).all() and (pixels < [lens.width - 4, lens.height - 4]).all():
                detections[tag] = TagDetection(layout.size * UNIT_SQUARE, pixels)
        observations.append(PhotoObservation(folder / f"{i:03d}.png", lens.width, lens.height, detections))
    return observations
