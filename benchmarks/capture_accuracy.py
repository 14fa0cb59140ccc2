"""Accuracy of captures: poses, lens and tag layout against the truth of synthetic photos."""

import argparse
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.synthetic.photos import Flaws, write_capture
from benchmarks.tables import Rows, name_tables
from nerf_lightning.cameras import Distortion, look_at
from nerf_lightning.capture.pipeline import capture_scene
from nerf_lightning.capture.poses.flips import resolve_flips
from nerf_lightning.capture.poses.geometry import angle_between, invert_pose, project_points
from nerf_lightning.capture.poses.planar_pnp import estimate_tag_poses
from nerf_lightning.capture.poses.pose_solver import PoseSolution
from nerf_lightning.capture.tags.detect import TagDetection
from nerf_lightning.capture.tags.tag_layout import TagLayout, flat_pose
from nerf_lightning.dataset.intrinsics import Intrinsics

LENS = Intrinsics(1024, 768, 900.0, 900.0, 520.0, 380.0, Distortion(k1=-0.2, k2=0.05))
TAG_SIZE = 0.06
SIX_POSES = {3 * row + col: flat_pose(0.09 * col, -0.09 * row) for row in (0, 1) for col in (0, 1, 2)}
SHEETS = {
    "one tag": TagLayout("DICT_4X4_50", TAG_SIZE, {0: flat_pose(0, 0)}),
    "six tags": TagLayout("DICT_4X4_50", TAG_SIZE, SIX_POSES),
}
CAMERA_FLAWS = Flaws(blur=0.5, noise=2.0)
CAPTURES = (("one tag", 40, None), ("six tags", 40, None), ("one tag", 30, 3))
"""Sheet, photos of the object, and N if every N-th of them has its tags hidden."""
SHEET_PHOTOS = 30
RANDOM_WALKS = ((15.0, 40, False), (10.0, 40, False), (15.0, 20, False), (15.0, 40, True))
"""Tilt in degrees, photos per change of direction, and whether the photos are shuffled."""
FLIPPED_RAD = np.radians(5)
"""A pose is flipped if its angular error exceeds the other solution's by more than this."""


def measure_accuracy(folder: Path, seed: int) -> list[dict[str, Any]]:
    """Measures captures with unknown layouts; medians over photos, by registration method."""
    rows = []
    for number, (name, views, hide) in enumerate(CAPTURES):
        path, layout = folder / str(number), SHEETS[name]
        truth = write_capture(path, layout, LENS, SHEET_PHOTOS, views, CAMERA_FLAWS, seed, hide=hide)
        capture = capture_scene(path / "calibration", path / "photos", TAG_SIZE, path / "scene.npz")
        sheet = capture.calibration.solution
        groups = {"sheet": [(invert_pose(w2c), photo) for photo, w2c in sheet.w2c.items()]}
        for by in ("tags", "texture") if hide else ("tags",):
            groups[by] = [(p.c2w, p.name) for p in capture.photos if p.c2w is not None and (p.method or "tags") == by]
        for by, poses in groups.items():
            solution, true_poses = (sheet, truth.calibration) if by == "sheet" else (capture.solution, truth.photos)
            pairs = [(solve_home_frame(solution, layout) @ pose, true_poses[photo]) for pose, photo in poses]
            centers = [np.linalg.norm(a[:3, 3] - b[:3, 3]) / np.linalg.norm(b[:3, 3]) for a, b in pairs]
            row = {"capture": name + (", hidden" if hide else ""), "method": by, "registered": len(pairs)}
            row["focal_percent"] = 100 * abs(capture.calibration.lens.fx / LENS.fx - 1)
            row["center_percent"] = 100 * float(np.median(centers)) if pairs else None
            row["degrees"] = float(np.degrees(np.median([angle_between(a, b) for a, b in pairs]))) if pairs else None
            rows.append({**row, "layout_mm": measure_layout_error(solution, layout)})
    return rows


def solve_home_frame(solution: PoseSolution, layout: TagLayout) -> np.ndarray:
    """Transform from the solved world, the frame of one tag, to the true one."""
    return layout.poses[next(tag for n, tag in enumerate(solution.tags) if n in solution.fixed)]


def measure_layout_error(solution: PoseSolution, layout: TagLayout) -> float:
    """Largest position error of a tag, millimeters."""
    to_truth = solve_home_frame(solution, layout)
    shifts = [(to_truth @ pose)[:3, 3] - layout.poses[tag][:3, 3] for tag, pose in solution.tags.items()]
    return 1000 * max(float(np.linalg.norm(shift)) for shift in shifts)


def make_random_walk(count: int, seed: int, tilt: float, pace: int) -> list[np.ndarray]:
    """World-to-camera poses along a random walk in front of a tag: mostly within `tilt` degrees of its normal, changing
    direction about every `pace` photos."""
    rng = np.random.default_rng(seed)
    kernel = np.exp(-(np.linspace(-3, 3, pace) ** 2))
    kernel /= np.linalg.norm(kernel)
    a, b, distance_noise, roll = (np.convolve(rng.standard_normal(count + pace - 1), kernel, "valid") for _ in range(4))
    a, b, distance = np.radians(tilt / 2) * a, np.radians(tilt / 2) * b, 0.5 + 0.1 * distance_noise.clip(-2, 2)
    eyes = distance[:, None] * np.stack([np.sin(a), np.sin(b) * np.cos(a), np.cos(a) * np.cos(b)], axis=1)
    upright = look_at(torch.from_numpy(eyes), torch.zeros(3).double(), torch.tensor([0.0, 1.0, 0.0]).double())
    turns = np.tile(np.eye(4), (count, 1, 1))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(0.3 * roll)
    turns[:, 1, 0] = np.sin(0.3 * roll)
    turns[:, 0, 1] = -turns[:, 1, 0]
    return [invert_pose(pose) for pose in upright.numpy() @ turns]


def count_flips(
    seed: int, count: int, tilt: float, pace: int, noise: float = 0.5, shuffled: bool = False
) -> dict[str, int]:
    """Counts flipped poses of a single tag along a random walk, by PnP alone and with the photos' order.

    Args:
        noise: standard deviation of the corners, pixels.
        shuffled: whether the photos are in random order.
    """
    lens = Intrinsics(1024, 768, 900.0, 900.0, 512.0, 384.0)
    points = SHEETS["one tag"].corners(0)
    truth, rng = make_random_walk(count, seed, tilt, pace), np.random.default_rng(seed + 100)
    if shuffled:
        truth = [truth[i] for i in rng.permutation(count)]
    corners = [(points, project_points(lens, pose, points) + noise * rng.standard_normal((4, 2))) for pose in truth]
    hypotheses = [estimate_tag_poses(lens, TagDetection(*pair)) for pair in corners]
    errors = [[angle_between(pose, h.pose) for h in pair] for pose, pair in zip(truth, hypotheses, strict=True)]
    return {
        method: sum(bool(e[i] > min(e) + FLIPPED_RAD) for e, i in zip(errors, chosen, strict=True))
        for method, chosen in (("alone", [0] * count), ("in_order", resolve_flips(hypotheses, [points] * count)))
    }


def measure_flips(seeds: list[int], count: int = 500) -> list[dict[str, Any]]:
    """Counts flipped poses along all random walks."""
    rows = []
    for (tilt, pace, shuffled), seed in itertools.product(RANDOM_WALKS, seeds):
        walk = f"{tilt:g} degrees, {pace} photos a turn{', shuffled' if shuffled else ''}"
        flips = count_flips(seed, count, tilt, pace, shuffled=shuffled)
        rows.append({"walk": walk, "seed": seed, "photos": count, **flips})
    return rows


def measure(args: argparse.Namespace) -> Rows:
    """Measures both tables."""
    accuracy = measure_accuracy(args.output / "capture", args.seeds[0])
    return name_tables({"flips": measure_flips(args.seeds), "capture": accuracy})
