"""How well a capture finds the known cameras of synthetic photos, and what its errors cost a field."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.methods import train
from benchmarks.synthetic.photos import Flaws, Truth, write_capture
from benchmarks.tables import Rows, named
from nerf_lightning.cameras import look_at
from nerf_lightning.capture.outputs import Packing
from nerf_lightning.capture.pack import pack
from nerf_lightning.capture.poses.flips import resolve_flips
from nerf_lightning.capture.poses.geometry import angle_between, inverse, project
from nerf_lightning.capture.poses.pose import mark_poses
from nerf_lightning.capture.poses.solve import Solved
from nerf_lightning.capture.run import Capture, capture
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.capture.tags.layout import TagLayout, flat_pose
from nerf_lightning.dataset.formats.npz import save_npz
from nerf_lightning.dataset.lens import Lens

LENS = Lens(1024, 768, 900.0, 900.0, 520.0, 380.0, (-0.2, 0.05, 0.0, 0.0, 0.0))
SIZE = 0.06
SHEETS = {
    "one tag": TagLayout("DICT_4X4_50", SIZE, {0: flat_pose(0, 0)}),
    "six tags": TagLayout(
        "DICT_4X4_50", SIZE, {3 * r + c: flat_pose(0.09 * c, -0.09 * r) for r in (0, 1) for c in (0, 1, 2)}
    ),
}
FLAWS = Flaws(blur=0.5, noise=2.0)
PHOTOS, VIEWS = 30, 40
"""Of the sheet, and of the object."""
HIDDEN_VIEWS = 30
"""Of the object, where the tag is hidden in a third of them."""
STEPS = 4500
"""Of both fields alike: seconds would let a busy machine decide."""
WALKS = ((15.0, 40, False), (10.0, 40, False), (15.0, 20, False), (15.0, 40, True))
"""Tilt in degrees, photos a turn, and whether their order is random."""
FLIPPED = np.radians(5)
"""A pose that is farther off than the other solution by more than this counts as flipped."""


def accuracy(folder: Path, seed: int) -> tuple[list[dict[str, Any]], dict[str, tuple[Capture, Truth]]]:
    """Captures of one tag and of a sheet of unknown layout, against the truth: medians over photos."""
    rows, done = [], {}
    for name, layout in SHEETS.items():
        place = folder / name.replace(" ", "_")
        truth = write_capture(place, layout, LENS, PHOTOS, VIEWS, FLAWS, seed)
        found = capture(place / "calibration", place / "photos", SIZE, Packing(place / "scene.npz"))
        of_sheet = [inverse(found.calibration.solved.w2c[i]) for i in found.calibration.solved.placed]
        sheet_truth = [truth.calibration[s.name] for s in found.calibration.used]
        placed = {photo.name: photo.c2w for photo in found.photos if photo.c2w is not None}
        rows.append(
            {
                "capture": name,
                "focal_percent": 100 * abs(found.calibration.lens.fx / LENS.fx - 1),
                **_errors("sheet", home(found.calibration.solved, layout), of_sheet, sheet_truth),
                **_errors(
                    "photos",
                    home(found.solved, layout),
                    list(placed.values()),
                    [truth.photos[photo] for photo in placed],
                ),
                "layout_mm": layout_error(found.calibration.solved, layout),
                "placed": f"{len(placed)}/{VIEWS}",
            }
        )
        done[name] = found, truth
    return rows, done


def hidden_tags(folder: Path, seed: int, views: int = HIDDEN_VIEWS) -> list[dict[str, Any]]:
    """The same of one tag that is hidden in a third of the photos, which are placed by their texture."""
    layout = SHEETS["one tag"]
    truth = write_capture(folder, layout, LENS, PHOTOS, views, FLAWS, seed, hide=3)
    found = capture(folder / "calibration", folder / "photos", SIZE, Packing(folder / "scene.npz"))
    rows = []
    for by in ("", "texture"):
        placed = {photo.name: photo.c2w for photo in found.photos if photo.c2w is not None and photo.by == by}
        exact = [truth.photos[name] for name in placed]
        rows.append(
            {
                "placed by": by or "tags",
                "placed": len(placed),
                "of": views // 3 if by else views - views // 3,
                "focal_percent": 100 * abs(found.calibration.lens.fx / LENS.fx - 1),
                **(_errors("photos", home(found.solved, layout), list(placed.values()), exact) if placed else {}),
            }
        )
    return rows


def home(solved: Solved, layout: TagLayout) -> np.ndarray:
    """From the solved world, which is the frame of one tag, to the true one."""
    return layout.poses[next(tag for n, tag in enumerate(solved.tags) if n in solved.fixed)]


def _errors(kind: str, to_truth: np.ndarray, found: list[np.ndarray], truth: list[np.ndarray]) -> dict[str, float]:
    """Medians over photos: centres in percent of their distance to the tags, rotations in degrees."""
    moved = [to_truth @ pose for pose in found]
    centres = [
        np.linalg.norm(a[:3, 3] - b[:3, 3]) / np.linalg.norm(b[:3, 3]) for a, b in zip(moved, truth, strict=True)
    ]
    turns = [angle_between(a, b) for a, b in zip(moved, truth, strict=True)]
    return {
        f"{kind}_centre_percent": 100 * float(np.median(centres)),
        f"{kind}_degrees": float(np.degrees(np.median(turns))),
    }


def layout_error(solved: Solved, layout: TagLayout) -> float:
    """Millimetres by which the tag farthest off lies elsewhere."""
    to_truth = home(solved, layout)
    off = [(to_truth @ pose)[:3, 3] - layout.poses[tag][:3, 3] for tag, pose in solved.tags.items()]
    return 1000 * max(float(np.linalg.norm(shift)) for shift in off)


def stroll(count: int, seed: int, tilt: float, pace: int) -> list[np.ndarray]:
    """World to camera along a random walk in front of a tag: mostly within `tilt` degrees of its normal, with a turn about
    every `pace` photos."""
    rng = np.random.default_rng(seed)
    kernel = np.exp(-(np.linspace(-3, 3, pace) ** 2))
    kernel /= np.linalg.norm(kernel)
    a, b, further, roll = (np.convolve(rng.standard_normal(count + pace - 1), kernel, "valid") for _ in range(4))
    a, b, distance = np.radians(tilt / 2) * a, np.radians(tilt / 2) * b, 0.5 + 0.1 * further.clip(-2, 2)
    eyes = distance[:, None] * np.stack([np.sin(a), np.sin(b) * np.cos(a), np.cos(a) * np.cos(b)], axis=1)
    upright = look_at(
        torch.from_numpy(eyes), torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 1.0, 0.0]).double()
    )
    turns = np.tile(np.eye(4), (count, 1, 1))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(0.3 * roll)
    turns[:, 1, 0] = np.sin(0.3 * roll)
    turns[:, 0, 1] = -turns[:, 1, 0]
    return [inverse(pose) for pose in upright.numpy() @ turns]


def flips(seeds: list[int], count: int = 500) -> list[dict[str, Any]]:
    """Flipped poses among photos of a single tag, of PnP alone and with the photos' order."""
    return [
        {
            "walk": f"{tilt:g} degrees, {pace} photos a turn{', shuffled' if shuffled else ''}",
            "seed": seed,
            "photos": count,
            **flips_of_walk(seed, count, tilt, pace, shuffled=shuffled),
        }
        for tilt, pace, shuffled in WALKS
        for seed in seeds
    ]


def flips_of_walk(
    seed: int, count: int, tilt: float, pace: int, noise: float = 0.5, shuffled: bool = False
) -> dict[str, int]:
    """The same of one walk, see `stroll`; `noise` in pixels; `shuffled`: the photos are in random order."""
    lens = Lens(1024, 768, 900.0, 900.0, 512.0, 384.0)
    points = SHEETS["one tag"].corners(0)
    truth, rng = stroll(count, seed, tilt, pace), np.random.default_rng(seed + 100)
    if shuffled:
        truth = [truth[i] for i in rng.permutation(count)]
    seen = [(points, project(lens, pose, points) + noise * rng.standard_normal((4, 2))) for pose in truth]
    options = [mark_poses(lens, Mark(*pair)) for pair in seen]
    errors = [[angle_between(pose, h.pose) for h in found] for pose, found in zip(truth, options, strict=True)]
    return {
        way: sum(bool(e[i] > min(e) + FLIPPED) for e, i in zip(errors, chosen, strict=True))
        for way, chosen in (("alone", [0] * count), ("in_order", resolve_flips(lens, options, seen)))
    }


def fields(folder: Path, found: Capture, truth: Truth, seed: int) -> list[dict[str, Any]]:
    """Held-out quality of a field on the solved cameras, and on the true ones of the same photos."""
    photos = [photo for photo in found.photos if photo.c2w is not None]
    place = found.sightings[0].path.parent
    exact = pack(
        [place / photo.name for photo in photos],
        np.stack([truth.photos[photo.name] for photo in photos]),
        truth.lens,
        "true",
        "",
    )
    rows = []
    for name, scene in (("solved", found.scene), ("true", exact)):
        path = folder / f"{name}.npz"
        save_npz(scene, path)
        run = train("capture", [f"dataset.path='{path}'", f"budget.steps={STEPS}"], seed, folder / f"run_{name}")
        rows.append({"cameras": name, "steps": STEPS, "psnr": run["psnr"], "ssim": run["ssim"]})
    return rows


def measure(args: argparse.Namespace) -> Rows:
    """All tables."""
    seeds, folder = args.seeds, args.output
    rows, done = accuracy(folder / "capture", seeds[0])
    tables = {
        "capture": rows,
        "flips": flips(seeds),
        "hidden tags": hidden_tags(folder / "hidden_tags", seeds[0]),
        "capture fields": fields(folder / "capture", *done["six tags"], seeds[0]),
    }
    return named(tables)
