"""Shapes: meshes of trained fields against the surfaces that were photographed."""

import argparse
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh

from benchmarks.capture import FLAWS, LENS, SHEETS, SIZE, home
from benchmarks.methods import train
from benchmarks.synthetic.photos import write_capture
from benchmarks.synthetic.tabletop import Tabletop
from benchmarks.tables import Rows, named
from nerf_lightning.capture.poses.solve import Solved
from nerf_lightning.capture.run import capture_scene
from nerf_lightning.capture.tags.layout import TagLayout
from nerf_lightning.export.mesh import mesh_file, training_views
from nerf_lightning.export.volume import sample_volume
from nerf_lightning.runs.open import SceneRun, open_scene_run
from nerf_lightning.synthetic.solids import bulldozer
from nerf_lightning.utils.device import the_device

PHOTOS, VIEWS = 20, 40
"""Of the sheet, and of the object."""
ABOVE = 0.005
"""Metres above the table from which on the object alone is looked at: a few voxels above the paper."""
LONGEST = 800
"""Pixels of the photos' longer side, of 1024: a mesh is as fine as they are."""
LONGER = 3
"""Times the seconds that a capture is trained for, where every ray hits something."""


def distance_to_bricks(points: np.ndarray) -> np.ndarray:
    """Signed distance [N] of points [N, 3] to the built-in scene's solids, negative inside: exact outside of all, and inside
    at most the depth in the one that a point lies deepest in."""
    solids = bulldozer()
    least = np.full(len(points), np.inf)
    for index in range(len(solids.centre)):
        local, half = (points - solids.centre[index]) @ solids.axes[index].T, solids.half[index]
        if solids.cylinder[index]:
            beyond = np.stack([np.hypot(local[:, 0], local[:, 1]) - half[0], np.abs(local[:, 2]) - half[2]], axis=1)
        else:
            beyond = np.abs(local) - half
        outside, inside = np.linalg.norm(beyond.clip(0), axis=1), beyond.max(1).clip(max=0)
        least = np.minimum(least, outside + inside)
    return least


def mesh_of(run: SceneRun, box: torch.Tensor | None = None) -> tuple[trimesh.Trimesh, float]:
    """A run's mesh, read back from its file, and the side of a voxel in the same unit."""
    volume = sample_volume(run, box=box)
    content = mesh_file(run, training_views(run), volume, None, ".ply").content
    mesh: Any = trimesh.load(io.BytesIO(content), file_type="ply")
    return mesh, volume.cell * run.scale


def of_bricks(seconds: float, output: Path) -> Rows:
    """How far the vertices of a mesh are from the built-in scene's surface, in voxels.

    A random background teaches a field the outlines too: before a black one dark things need no density.
    """
    rows: Rows = []
    for recipe in ("tensorf_medium", "voxels_medium", "hashgrid_medium"):
        folder = output / "shapes" / recipe
        given = ["dataset=bricks", f"recipe={recipe}", f"budget.seconds={seconds}", "renderer.background=random"]
        trained = train("lego", given, 0, folder)
        mesh, voxel = mesh_of(open_scene_run(folder, the_device("auto")))
        off = np.abs(distance_to_bricks(np.asarray(mesh.vertices))) / voxel
        row = {"field": recipe, "psnr": trained["psnr"], "voxel": voxel}
        row |= {f"p{share}_voxels": float(np.percentile(off, share)) for share in (50, 95, 99)}
        rows.append({**row, "watertight": mesh.is_watertight, "triangles": len(mesh.faces)})
    return rows


def true_box(table: Tabletop) -> np.ndarray:
    """Corners [2, 3] of what of the object reaches higher than `ABOVE`, metres in the layout's frame."""
    solids = bulldozer()
    reach = np.abs(solids.axes * solids.half[:, :, None]).sum(1)
    corners = table.shift + table.scale * (solids.centre + np.stack([-reach, reach]))
    high_enough = corners[:, corners[1, :, 2] > ABOVE]
    return np.stack([high_enough[0].min(0), high_enough[1].max(0)])


def size_of_capture(run: SceneRun, solved: Solved, layout: TagLayout) -> Rows:
    """How large the object is in the mesh of a capture's run, beside its true size.

    Args:
        run: of the capture's scene.
        solved: its poses, in the frame of the tag that the solver took for home.
        layout: of the tags, in whose frame the truth is known.
    """
    low, high = true_box(Tabletop(layout))
    to_truth = torch.from_numpy(home(solved, layout)).double()
    room = 0.2 * (high - low)
    box = torch.from_numpy(np.stack([low - room, high + room])).float()
    box[0, 2] = ABOVE
    mesh, voxel = mesh_of(replace(run, to_source=to_truth @ run.to_source), box)
    largest = max(mesh.split(only_watertight=False), key=lambda part: len(part.faces))
    rows: Rows = []
    for axis, name in enumerate("xyz"):
        start, true_start = (largest.bounds[0, axis], low[axis]) if axis < 2 else (0.0, 0.0)  # it stands on the table
        size, true = largest.bounds[1, axis] - start, high[axis] - true_start
        rows.append(
            {"axis": name, "true_m": true, "mesh_m": size, "off_percent": 100 * (size / true - 1), "voxel_m": voxel}
        )
    return rows


def of_capture(seconds: float, output: Path) -> Rows:
    """The same for a synthetic capture."""
    folder = output / "shapes" / "capture"
    layout = SHEETS["six tags"]
    write_capture(folder, layout, LENS, PHOTOS, VIEWS, FLAWS, 0)
    found = capture_scene(folder / "calibration", folder / "photos", SIZE, folder / "scene.npz", longest=LONGEST)
    given = [f"dataset.path='{folder}/scene.npz'", f"budget.seconds={LONGER * seconds}"]
    trained = train("capture", given, 0, folder / "run")
    rows = size_of_capture(open_scene_run(folder / "run", the_device("auto")), found.solved, layout)
    return [{**row, "psnr": trained["psnr"]} for row in rows]


def measure(args: argparse.Namespace) -> Rows:
    """Both tables."""
    seconds, output = args.budgets[0], args.output
    return named({"shapes": of_bricks(seconds, output), "capture shapes": of_capture(seconds, output)})
