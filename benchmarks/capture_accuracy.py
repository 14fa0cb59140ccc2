"""How well a capture finds the known cameras of synthetic photos."""

import argparse
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
SHEETS = {
    "one tag": TagLayout("DICT_4X4_50", TAG_SIZE, {0: flat_pose(0, 0)}),
    "six tags": TagLayout(
        "DICT_4X4_50", TAG_SIZE, {3 * r + c: flat_pose(0.09 * c, -0.09 * r) for r in (0, 1) for c in (0, 1, 2)}
    ),
}
CAMERA_FLAWS = Flaws(blur=0.5, noise=2.0)
CAPTURES = (("one tag", 40, None), ("six tags", 40, None), ("one tag", 30, 3))
"""Sheet, photos of the object, and every which of them has its tags hidden."""
SHEET_PHOTOS = 30
RANDOM_WALKS = ((15.0, 40, False), (10.0, 40, False), (15.0, 20, False), (15.0, 40, True))
"""Tilt in degrees, photos a turn, and whether their order is random."""
FLIPPED_RAD = np.radians(5)
"""A pose that is farther off than the other solution by more than this counts as flipped."""


def measure_accuracy(folder: Path, seed: int) -> list[dict[str, Any]]:
    """Captures of sheets of unknown layout against the truth: medians over photos, by what has placed them."""
    rows = []
    for number, (name, views, hide) in enumerate(CAPTURES):
        place, layout = folder / str(number), SHEETS[name]
        truth = write_capture(place, layout, LENS, SHEET_PHOTOS, views, CAMERA_FLAWS, seed, hide=hide)
        found = capture_scene(place / "calibration", place / "photos", TAG_SIZE, place / "scene.npz")
        sheet = found.calibration.solution
        groups = {"sheet": [(invert_pose(w2c), photo) for photo, w2c in sheet.w2c.items()]}
        for by in ("tags", "texture") if hide else ("tags",):
            groups[by] = [(p.c2w, p.name) for p in found.photos if p.c2w is not None and (p.method or "tags") == by]
        for by, poses in groups.items():
            of, exact = (sheet, truth.calibration) if by == "sheet" else (found.solution, truth.photos)
            pairs = [(solve_home_frame(of, layout) @ pose, exact[photo]) for pose, photo in poses]
            centres = [np.linalg.norm(a[:3, 3] - b[:3, 3]) / np.linalg.norm(b[:3, 3]) for a, b in pairs]
            row = {"capture": name + (", hidden" if hide else ""), "placed by": by, "placed": len(pairs)}
            row["focal_percent"] = 100 * abs(found.calibration.lens.fx / LENS.fx - 1)
            row["centre_percent"] = 100 * float(np.median(centres)) if pairs else None
            row["degrees"] = float(np.degrees(np.median([angle_between(a, b) for a, b in pairs]))) if pairs else None
            rows.append({**row, "layout_mm": measure_layout_error(of, layout)})
    return rows


def solve_home_frame(solution: PoseSolution, layout: TagLayout) -> np.ndarray:
    """From the solved world, which is the frame of one tag, to the true one."""
    return layout.poses[next(tag for n, tag in enumerate(solution.tags) if n in solution.fixed)]


def measure_layout_error(solution: PoseSolution, layout: TagLayout) -> float:
    """Millimetres by which the tag farthest off lies elsewhere."""
    to_truth = solve_home_frame(solution, layout)
    off = [(to_truth @ pose)[:3, 3] - layout.poses[tag][:3, 3] for tag, pose in solution.tags.items()]
    return 1000 * max(float(np.linalg.norm(shift)) for shift in off)


def make_random_walk(count: int, seed: int, tilt: float, pace: int) -> list[np.ndarray]:
    """World to camera along a random walk in front of a tag: mostly within `tilt` degrees of its normal, with a turn about
    every `pace` photos."""
    rng = np.random.default_rng(seed)
    kernel = np.exp(-(np.linspace(-3, 3, pace) ** 2))
    kernel /= np.linalg.norm(kernel)
    a, b, further, roll = (np.convolve(rng.standard_normal(count + pace - 1), kernel, "valid") for _ in range(4))
    a, b, distance = np.radians(tilt / 2) * a, np.radians(tilt / 2) * b, 0.5 + 0.1 * further.clip(-2, 2)
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
    """Flipped poses of a single tag along a walk (see there), of PnP alone and with the photos' order.

    Args:
        noise: of corners, pixels.
        shuffled: the photos are in random order.
    """
    lens = Intrinsics(1024, 768, 900.0, 900.0, 512.0, 384.0)
    points = SHEETS["one tag"].corners(0)
    truth, rng = make_random_walk(count, seed, tilt, pace), np.random.default_rng(seed + 100)
    if shuffled:
        truth = [truth[i] for i in rng.permutation(count)]
    seen = [(points, project_points(lens, pose, points) + noise * rng.standard_normal((4, 2))) for pose in truth]
    options = [estimate_tag_poses(lens, TagDetection(*pair)) for pair in seen]
    errors = [[angle_between(pose, h.pose) for h in found] for pose, found in zip(truth, options, strict=True)]
    return {
        how: sum(bool(e[i] > min(e) + FLIPPED_RAD) for e, i in zip(errors, chosen, strict=True))
        for how, chosen in (("alone", [0] * count), ("in_order", resolve_flips(options, [points] * count)))
    }


def measure_flips(seeds: list[int], count: int = 500) -> list[dict[str, Any]]:
    """Flipped poses along all walks."""
    return [
        {
            "walk": f"{tilt:g} degrees, {pace} photos a turn{', shuffled' if shuffled else ''}",
            "seed": seed,
            "photos": count,
            **count_flips(seed, count, tilt, pace, shuffled=shuffled),
        }
        for tilt, pace, shuffled in RANDOM_WALKS
        for seed in seeds
    ]


def measure(args: argparse.Namespace) -> Rows:
    """All tables."""
    return name_tables(
        {"flips": measure_flips(args.seeds), "capture": measure_accuracy(args.output / "capture", args.seeds[0])}
    )
