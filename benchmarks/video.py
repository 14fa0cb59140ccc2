"""Video frames: selection from a video with a third of its frames blurred, and their registration by COLMAP."""

import argparse
import os
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8

from benchmarks.camera_noise import fit_similarity
from benchmarks.capture_accuracy import SHEETS
from benchmarks.synthetic.photos import Flaws, render_photo
from benchmarks.synthetic.video import blur_images, place_cameras, write_video
from benchmarks.tables import Row, Rows
from nerf_lightning.cameras import Distortion, transform_poses
from nerf_lightning.capture.poses.geometry import angle_between, invert_pose
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.sfm.photo_folder import run_sfm
from nerf_lightning.dataset.sfm.video_frames import write_frames
from nerf_lightning.synthetic.tracer import render_shadow_map

LENS = Intrinsics(480, 360, 420.0, 420.0, 242.0, 178.0, Distortion(k1=-0.1, k2=0.02))
FLAWS = Flaws(blur=0.4, noise=2.0)
TURN_FRAMES, PAUSE_FRAMES = 120, 30
"""Frames of a full turn, and of the pause after a third of it."""
FRAME_COUNTS = (20, 40)
"""Numbers of frames to select; a blurred one is most likely if there are many."""


def measure(args: argparse.Namespace) -> Rows:
    """Measures a turn around the bulldozer with a pause, by number of selected frames; registers the largest number."""
    layout, seed, folder = SHEETS["six tags"], args.seeds[0], args.output
    before, after = np.split(place_cameras(layout, LENS, TURN_FRAMES), [TURN_FRAMES // 3])
    c2w = np.concatenate([before, np.repeat(after[:1], PAUSE_FRAMES, axis=0), after])
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "turn.mp4"
    write_video(file, blur_images(_render_frames(c2w, seed), seed))
    rows: Rows = []
    for count in FRAME_COUNTS:
        started = time.perf_counter()
        frames = folder / f"frames_{count}"
        shutil.rmtree(frames, ignore_errors=True)
        frames.mkdir()
        write_frames(file, frames, count)
        photos = sorted(frames.glob("*.jpg"))
        chosen = [int(photo.stem) for photo in photos]
        blurred = range(1, len(c2w), 3)
        row: Row = {
            "frames": len(c2w),
            "selected": len(chosen),
            "blurred_percent_rejected": 100 - 100 * len(set(chosen) & set(blurred)) / len(blurred),
            "selected_in_pause": sum(TURN_FRAMES // 3 <= index <= TURN_FRAMES // 3 + PAUSE_FRAMES for index in chosen),
            "longest_gap": int(max(np.diff([count_moving_frames(index) for index in chosen]))),
            "selection_seconds": time.perf_counter() - started,
        }
        if count == max(FRAME_COUNTS):
            started = time.perf_counter()
            row |= _measure_registration(run_sfm(photos[0].parent), c2w, len(chosen))
            row["registration_seconds"] = time.perf_counter() - started
        rows.append(row)
    return rows


def count_moving_frames(index: int) -> int:
    """Number of frames of the turn before a frame of the video, without the pause."""
    return min(index, max(TURN_FRAMES // 3, index - PAUSE_FRAMES))


def _render_frames(c2w: Float[np.ndarray, "N 4 4"], seed: int) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    render_shadow_map()  # cached before the threads need it
    layout = SHEETS["six tags"]

    def render(index: int) -> UInt8[np.ndarray, "H W 3"]:
        return render_photo(layout, LENS, c2w[index], True, FLAWS, seed + index, samples=2)

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        yield from pool.map(render, range(len(c2w)))


def _measure_registration(folder: Path, c2w: Float[np.ndarray, "N 4 4"], num_selected: int) -> Row:
    """Errors of registered frames after alignment; center errors in percent of the distance from the mean center."""
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    images = [image for image in model.images.values() if image.has_pose]
    truth = np.stack([c2w[int(Path(image.name).stem)] for image in images])
    last = [[0.0, 0.0, 0.0, 1.0]]
    poses = np.stack([invert_pose(np.concatenate([image.cam_from_world().matrix(), last])) for image in images])
    ours = align_poses(poses, truth)
    distance = np.linalg.norm(truth[:, :3, 3] - truth[:, :3, 3].mean(0), axis=-1)
    camera = model.cameras[images[0].camera_id]
    return {
        "registered": f"{len(images)}/{num_selected}",
        "center_percent": 100 * float(np.median(np.linalg.norm(ours[:, :3, 3] - truth[:, :3, 3], axis=-1) / distance)),
        "degrees": float(np.degrees(np.median([angle_between(a, b) for a, b in zip(ours, truth, strict=True)]))),
        "focal_percent": 100 * abs(camera.mean_focal_length() / LENS.fx - 1),
    }


def align_poses(poses: Float[np.ndarray, "N 4 4"], truth: Float[np.ndarray, "N 4 4"]) -> Float[np.ndarray, "N 4 4"]:
    """Aligns camera poses by the similarity that best fits their centers to the truth."""
    similarity = fit_similarity(*(torch.from_numpy(p[:, :3, 3]) for p in (poses, truth)))
    return transform_poses(torch.from_numpy(poses), similarity).numpy()
