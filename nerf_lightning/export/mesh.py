"""Mesh, point cloud and voxel grid files, in the frame and unit of the photos' own file."""

import io
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from nerf_lightning.cameras import Cameras, make_spiral_path
from nerf_lightning.drawing.panels import to_uint8
from nerf_lightning.errors import InputError
from nerf_lightning.export.compress import MAX_VISIBILITY_VIEWS, subsample_cameras
from nerf_lightning.export.surface import Surface, extract_surface, find_unoccluded_cells
from nerf_lightning.export.volume import POSITIONS_PER_SAMPLE, Volume
from nerf_lightning.runs.open import LoadedSceneRun
from nerf_lightning.runs.reload import reload_data
from nerf_lightning.system import NeRF3D

if TYPE_CHECKING:
    import trimesh

SUFFIXES = {"mesh": (".ply", ".glb", ".obj", ".stl"), "points": (".ply",), "voxels": (".npz",)}
"""File suffixes by content, default first."""
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation from z up (scenes) to y up (glTF), stored as the node's transform."""
FLOAT32_ROUNDOFF = 2.0**-24
"""Relative rounding error of float32."""
MAX_RELATIVE_ERROR = 1e-4
"""Largest rounding error of a vertex, relative to the mesh's longest side: a fortieth of the finest cell."""
OBJ_DIGITS, OBJ_COLOR_DECIMALS = 9, 4
"""Significant digits of OBJ coordinates, relative to the mesh's longest side, and decimals of colors."""


class ExportedFile(NamedTuple):
    """Content and description of a file."""

    content: bytes
    description: str


def select_training_views(run: LoadedSceneRun, photos: Path | None = None) -> Cameras:
    """Evenly spaced training cameras; a spiral from the orbit if photos are missing."""
    try:
        data = reload_data(run.cfg, run.scene, photos)
    except InputError as error:
        if photos is not None:
            raise
        print(f"without the photos' cameras, from a spiral: {error}")
        return make_spiral_path(run.orbit, MAX_VISIBILITY_VIEWS)
    return subsample_cameras(data)


@torch.no_grad()
def query_colors(
    system: NeRF3D, positions: Float[Tensor, "N 3"], outwards: Float[Tensor, "N 3"]
) -> UInt8[ndarray, "N 3"]:
    """Colors of a field at world positions, seen from outside along `outwards`."""
    batch_size = POSITIONS_PER_SAMPLE * system.chunk
    parts = [
        system.field(points.to(system.device), -normals.to(system.device))[1].cpu()
        for points, normals in zip(positions.split(batch_size), outwards.split(batch_size), strict=True)
    ]
    return to_uint8(torch.cat([torch.zeros(0, 3), *parts]))


def extract_mesh(
    run: LoadedSceneRun, cameras: Cameras, volume: Volume, threshold: float | None
) -> tuple["trimesh.Trimesh", Surface]:
    """Extracts the surface visible to cameras, with vertex colors, in the dataset's frame."""
    import trimesh

    surface = extract_surface(volume, find_unoccluded_cells(run.system, volume, cameras), threshold)
    normals = torch.from_numpy(surface.normals)
    positions = torch.from_numpy(surface.vertices)
    # Half a cell inside: photos do not constrain the color outside the surface.
    rgb = query_colors(run.system, positions - normals * (volume.cell / 2), normals)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=rgb, process=False)
    mesh.apply_transform(run.to_source.numpy())
    return mesh, surface


def build_mesh_file(
    run: LoadedSceneRun, cameras: Cameras, volume: Volume, threshold: float | None, suffix: str
) -> ExportedFile:
    """Builds a colored mesh as .ply, .obj or .glb, or triangles only as .stl."""
    mesh, surface = extract_mesh(run, cameras, volume, threshold)
    content = encode_mesh(mesh, suffix, run.to_source[:3, :3].T.numpy() / run.scale)
    description = [
        f"{len(mesh.faces):,} triangles",
        "watertight" if mesh.is_watertight else "with open edges",
        " x ".join(f"{side:.4g}" for side in mesh.extents) + " in the photos' unit",
        f"surface at opacity {surface.threshold:.2f}",
        *([f"{surface.floaters} floating pieces left out"] if surface.floaters else []),
    ]
    return ExportedFile(content, ", ".join(description))


def build_points_file(run: LoadedSceneRun, cameras: Cameras, volume: Volume, threshold: float | None) -> ExportedFile:
    """Builds a .ply file of the mesh's vertices and colors."""
    mesh, surface = extract_mesh(run, cameras, volume, threshold)
    colors: Any = mesh.visual
    content = encode_ply(mesh.vertices, colors.vertex_colors[:, :3])
    return ExportedFile(content, f"{len(mesh.vertices):,} points, surface at opacity {surface.threshold:.2f}")


def build_voxels_file(run: LoadedSceneRun, volume: Volume) -> ExportedFile:
    """Builds an .npz file of density and color.

    `density` [X, Y, Z] is per unit of the dataset's frame, `rgb` [X, Y, Z, 3] the color seen along the density gradient,
    `to_source` [4, 4] maps indices (integers are cell centers) to the dataset's frame.
    """
    solid = volume.density > 0
    index = solid.nonzero()
    parts = torch.gradient(volume.opacity) if min(solid.shape) > 1 else [torch.zeros(solid.shape)] * 3
    outwards = -torch.nn.functional.normalize(torch.stack(parts, -1)[solid], dim=-1)
    outwards[outwards.norm(dim=1) < 0.5] = torch.tensor([0.0, 0.0, 1.0])  # arbitrary where density is constant
    rgb = np.zeros((*solid.shape, 3), np.uint8)
    rgb[solid.numpy()] = query_colors(run.system, volume.index_to_world(index.float()), outwards)
    file, density = io.BytesIO(), (volume.density / run.scale).numpy().astype(np.float32)
    np.savez_compressed(file, density=density, rgb=rgb, to_source=(run.to_source @ volume.to_world).numpy())
    shape = " x ".join(map(str, solid.shape))
    return ExportedFile(file.getvalue(), f"{shape} cells, {len(index):,} of them not empty")


def encode_ply(vertices: Float[ndarray, "V 3"], rgb: UInt8[ndarray, "V 3"], faces: ndarray | None = None) -> bytes:
    """Encodes a binary PLY file (Turk 1994) with float64 vertices; trimesh writes float32.

    Args:
        vertices: in the file's frame.
        rgb: vertex colors.
        faces: [F, 3] vertex indices; None for a point cloud.
    """
    channels = ("red", "green", "blue")
    kinds = [(name, "<f8") for name in "xyz"] + [(name, "u1") for name in channels]
    body = np.rec.fromarrays([*vertices.T, *rgb.T], dtype=kinds).tobytes()
    lines = ["ply", "format binary_little_endian 1.0", "comment nerf_lightning", f"element vertex {len(vertices)}"]
    lines += [*(f"property double {name}" for name in "xyz"), *(f"property uchar {name}" for name in channels)]
    if faces is not None:
        kinds = [("count", "u1"), ("a", "<i4"), ("b", "<i4"), ("c", "<i4")]
        body += np.rec.fromarrays([np.full(len(faces), 3), *faces.T], dtype=kinds).tobytes()
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header", ""]).encode() + body


def encode_mesh(mesh: "trimesh.Trimesh", suffix: str, rotation: Float[ndarray, "3 3"]) -> bytes:
    """Encodes a colored mesh as .ply, .obj, .stl or .glb.

    GLB stores float32: vertices are relative to the mesh's center, and the node's transform restores it.

    Args:
        mesh: with vertex colors.
        suffix: of the file.
        rotation: to z up of a GLB file's node.

    Raises:
        InputError: float32 of an .stl file is too coarse for the coordinates.
    """
    colors: Any = mesh.visual
    content: Any
    if suffix == ".ply":
        return encode_ply(mesh.vertices, colors.vertex_colors[:, :3], mesh.faces)
    if suffix == ".obj":
        digits = max(OBJ_COLOR_DECIMALS, OBJ_DIGITS - math.floor(math.log10(float(mesh.extents.max()))))
        content = mesh.export(file_type="obj", digits=digits, header="nerf_lightning", include_normals=False)
        return content.encode()
    if suffix == ".stl":
        farthest = float(np.abs(mesh.vertices).max())
        if farthest * FLOAT32_ROUNDOFF > MAX_RELATIVE_ERROR * mesh.extents.max():
            problem = f".stl for coordinates up to {farthest:.6g}, too large for its single precision"
            raise InputError("export", "output", problem, ".obj, .ply or .glb")
        content = mesh.export(file_type="stl")
        return content
    import trimesh

    center, centered = mesh.vertices.mean(0), mesh.copy()
    centered.vertices = mesh.vertices - center
    scene, node = trimesh.Scene(), np.eye(4)
    node[:3, :3], node[:3, 3] = Y_UP @ rotation, Y_UP @ center
    scene.add_geometry(centered, transform=node)
    return scene.export(file_type="glb")
