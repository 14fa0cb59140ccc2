"""Coloured triangles and points as files of other programs: PLY, OBJ, STL and GLB, each as exact as the format allows."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

if TYPE_CHECKING:
    import trimesh

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From z up, as scenes have it, to y up, as glTF wants it: written as the node's transform."""
SINGLE = 2.0**-24
"""Largest relative error of a number rounded to single precision."""
MAX_ERROR = 1e-4
"""Largest rounding error of a vertex, as a share of a mesh's longest side: a fortieth of the finest cell's."""
DIGITS, COLOUR_DIGITS = 9, 4
"""Significant digits of an OBJ file's coordinates, relative to the mesh's longest side, and decimals of colours."""
STL_HEADER_BYTES = 80


def find_offset(vertices: Float[ndarray, "V 3"]) -> Float[ndarray, "3"]:
    """The round shift that vertices need to be stored in single precision; zero where they need none."""
    low, high = vertices.min(0), vertices.max(0)
    size = float((high - low).max())
    if size == 0 or float(np.abs(vertices).max()) * SINGLE <= MAX_ERROR * size:
        return np.zeros(3)
    return np.round((low + high) / 2, -math.ceil(math.log10(size)))


def format_offset(offset: Float[ndarray, "3"]) -> str:
    """An offset as text, to the last digit of double precision."""
    return ", ".join(f"{value:.17g}" for value in offset)


def encode_ply(vertices: Float[ndarray, "V 3"], rgb: UInt8[ndarray, "V 3"], faces: ndarray | None = None) -> bytes:
    """A binary PLY file with vertices in double precision (Turk 1994); trimesh writes single.

    Args:
        vertices: in the file's frame.
        rgb: of the vertices.
        faces: [F, 3] indices of vertices; None for points alone.
    """
    colours = ("red", "green", "blue")
    kinds = [(name, "<f8") for name in "xyz"] + [(name, "u1") for name in colours]
    body = np.rec.fromarrays([*vertices.T, *rgb.T], dtype=kinds).tobytes()
    lines = ["ply", "format binary_little_endian 1.0", "comment nerf_lightning", f"element vertex {len(vertices)}"]
    lines += [*(f"property double {name}" for name in "xyz"), *(f"property uchar {name}" for name in colours)]
    if faces is not None:
        kinds = [("count", "u1"), ("a", "<i4"), ("b", "<i4"), ("c", "<i4")]
        body += np.rec.fromarrays([np.full(len(faces), 3), *faces.T], dtype=kinds).tobytes()
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header", ""]).encode() + body


def encode_mesh(mesh: "trimesh.Trimesh", suffix: str, turn: Float[ndarray, "3 3"]) -> tuple[bytes, Float[ndarray, "3"]]:
    """A coloured mesh as .ply, .obj, .stl or .glb.

    Args:
        mesh: with a colour at each vertex.
        suffix: of the file.
        turn: the rotation of a GLB file's node to z up, about the offset.

    Returns:
        The file's content, and the offset that its coordinates lack: STL has single precision. GLB has too, but its node's
        transform, written as text, adds it.
    """
    colours: Any = mesh.visual
    content: Any
    if suffix == ".ply":
        return encode_ply(mesh.vertices, colours.vertex_colors[:, :3], mesh.faces), np.zeros(3)
    if suffix == ".obj":
        digits = max(COLOUR_DIGITS, DIGITS - math.floor(math.log10(float(mesh.extents.max()))))
        content = mesh.export(file_type="obj", digits=digits, header="nerf_lightning", include_normals=False)
        return content.encode(), np.zeros(3)
    offset = find_offset(mesh.vertices)
    moved = mesh.copy()
    moved.vertices = mesh.vertices - offset
    if suffix == ".stl":
        header = f"nerf_lightning, binary STL; offset {format_offset(offset)}".encode().ljust(STL_HEADER_BYTES)
        content = moved.export(file_type="stl")
        return header[:STL_HEADER_BYTES] + content[STL_HEADER_BYTES:], offset
    import trimesh

    scene, node = trimesh.Scene(), np.eye(4)
    node[:3, :3], node[:3, 3] = (
        Y_UP @ turn,
        Y_UP @ offset,
    )  # a turn about an origin that is far away would move the mesh
    scene.add_geometry(moved, transform=node)
    content = scene.export(file_type="glb")
    return content, offset
