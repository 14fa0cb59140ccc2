"""Mesh accuracy: meshes of trained fields against the true surfaces."""

import argparse
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from benchmarks.capture_accuracy import CAMERA_FLAWS, LENS, SHEETS, TAG_SIZE, solve_home_frame
from benchmarks.methods import train
from benchmarks.synthetic.photos import write_capture
from benchmarks.synthetic.tabletop import Tabletop
from benchmarks.tables import Rows, name_tables
from nerf_lightning.capture.pipeline import capture_scene
from nerf_lightning.capture.poses.pose_solver import PoseSolution
from nerf_lightning.capture.tags.tag_layout import TagLayout
from nerf_lightning.export.mesh import build_mesh_file, select_training_views
from nerf_lightning.export.volume import sample_volume
from nerf_lightning.runs.open import LoadedSceneRun, open_scene_run
from nerf_lightning.synthetic.solids import load_bulldozer
from nerf_lightning.utils.device import resolve_device

PHOTOS, VIEWS = 20, 40
"""Photos of the sheet, and of the object."""
MIN_HEIGHT_M = 0.005
"""Height above the table from which on only the object is measured: a few voxels above the paper."""
MAX_PHOTO_SIDE = 800
"""Longest side of the photos, of 1024 pixels: it limits the mesh's resolution."""
CAPTURE_TIME_FACTOR = 3
"""Training time of the capture relative to bricks: all of its rays hit something."""


def compute_bricks_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance [N] of points [N, 3] to the solids of the built-in scene, negative inside; exact outside all solids,
    inside a bound."""
    solids = load_bulldozer()
    distance = np.full(len(points), np.inf)
    for index in range(len(solids.center)):
        local, half = (points - solids.center[index]) @ solids.axes[index].T, solids.half_size[index]
        if solids.is_cylinder[index]:
            beyond = np.stack([np.hypot(local[:, 0], local[:, 1]) - half[0], np.abs(local[:, 2]) - half[2]], axis=1)
        else:
            beyond = np.abs(local) - half
        outside, inside = np.linalg.norm(beyond.clip(0), axis=1), beyond.max(1).clip(max=0)
        distance = np.minimum(distance, outside + inside)
    return distance


def extract_mesh(run: LoadedSceneRun, box: torch.Tensor | None = None) -> tuple[trimesh.Trimesh, float]:
    """Extracts a run's mesh through its file format; also the side of a voxel, in the same unit."""
    volume = sample_volume(run, box=box)
    content = build_mesh_file(run, select_training_views(run), volume, None, ".ply").content
    mesh: Any = trimesh.load(io.BytesIO(content), file_type="ply")
    return mesh, volume.cell * run.scale


def measure_bricks(seconds: float, output: Path) -> Rows:
    """Measures the distance of mesh vertices to the surface of the built-in scene, in voxels.

    Trained on a random background: on a black one dark surfaces need no density.
    """
    rows: Rows = []
    for recipe in ("tensorf_medium", "voxels_medium", "hashgrid_medium"):
        folder = output / "shapes" / recipe
        options = ["dataset=bricks", f"recipe={recipe}", f"budget.seconds={seconds}", "renderer.background=random"]
        trained = train("lego", options, 0, folder)
        mesh, voxel = extract_mesh(open_scene_run(folder, resolve_device("auto")))
        distance = np.abs(compute_bricks_distance(np.asarray(mesh.vertices))) / voxel
        row = {"field": recipe, "psnr": trained["psnr"], "voxel": voxel}
        row |= {f"p{share}_voxels": float(np.percentile(distance, share)) for share in (50, 95, 99)}
        rows.append({**row, "watertight": mesh.is_watertight, "triangles": len(mesh.faces)})
    return rows


def get_true_box(table: Tabletop) -> np.ndarray:
    """Bounding box [2, 3] of the object's part above `MIN_HEIGHT_M`, meters in the layout's frame."""
    solids = load_bulldozer()
    extent = np.abs(solids.axes * solids.half_size[:, :, None]).sum(1)
    corners = table.shift + table.scale * (solids.center + np.stack([-extent, extent]))
    high_enough = corners[:, corners[1, :, 2] > MIN_HEIGHT_M]
    return np.stack([high_enough[0].min(0), high_enough[1].max(0)])


def measure_object_size(run: LoadedSceneRun, solution: PoseSolution, layout: TagLayout) -> Rows:
    """Compares the object's size in the mesh of a capture with its true size.

    Args:
        run: trained on the capture's scene.
        solution: the capture's poses, in the frame of the reference tag.
        layout: true layout of the tags.
    """
    low, high = get_true_box(Tabletop(layout))
    to_truth = torch.from_numpy(solve_home_frame(solution, layout)).double()
    margin = 0.2 * (high - low)
    box = torch.from_numpy(np.stack([low - margin, high + margin])).float()
    box[0, 2] = MIN_HEIGHT_M
    mesh, voxel = extract_mesh(replace(run, to_source=to_truth @ run.to_source), box)
    largest = max(mesh.split(only_watertight=False), key=lambda part: len(part.faces))
    rows: Rows = []
    for axis, name in enumerate("xyz"):
        start, true_start = (largest.bounds[0, axis], low[axis]) if axis < 2 else (0.0, 0.0)  # it stands on the table
        size, true = largest.bounds[1, axis] - start, high[axis] - true_start
        row = {"axis": name, "true_m": true, "mesh_m": size, "off_percent": 100 * (size / true - 1)}
        rows.append({**row, "voxel_m": voxel})
    return rows


def measure_capture(seconds: float, output: Path) -> Rows:
    """Trains on a synthetic capture and measures the object's size in its mesh."""
    folder = output / "shapes" / "capture"
    layout = SHEETS["six tags"]
    write_capture(folder, layout, LENS, PHOTOS, VIEWS, CAMERA_FLAWS, 0)
    calibration, photos, scene = folder / "calibration", folder / "photos", folder / "scene.npz"
    capture = capture_scene(calibration, photos, TAG_SIZE, scene, max_side=MAX_PHOTO_SIDE)
    options = [f"dataset.path='{scene}'", f"budget.seconds={CAPTURE_TIME_FACTOR * seconds}"]
    trained = train("capture", options, 0, folder / "run")
    rows = measure_object_size(open_scene_run(folder / "run", resolve_device("auto")), capture.solution, layout)
    return [{**row, "psnr": trained["psnr"]} for row in rows]


def measure(args: argparse.Namespace) -> Rows:
    """Measures both tables."""
    seconds, output = args.budgets[0], args.output
    return name_tables({"shapes": measure_bricks(seconds, output), "capture shapes": measure_capture(seconds, output)})
