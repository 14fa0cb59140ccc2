"""Meshes, points and voxels, reloaded by another library and held against a ball."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from nerf_lightning.errors import InputError
from nerf_lightning.export.mesh import build_mesh_file, build_points_file, build_voxels_file
from nerf_lightning.export.volume import sample_volume
from tests.helpers.ball_runs import CENTER, MAX_DENSITY, RADIUS, make_ball_run

UTM = torch.tensor([5e5, 5.4112e6, 300.0], dtype=torch.float64)
"""Meters, as georeferenced files have coordinates."""
SCALE, SHIFT = 0.02, torch.tensor([5.0, -1.0, 2.0])
TURN = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
RESOLUTION = 40


def to_source() -> torch.Tensor:
    """Another place, direction and scale: what a capture's own frame is to the one a run works in."""
    similarity = torch.eye(4, dtype=torch.float64)
    similarity[:3, :3] = SCALE * TURN
    similarity[:3, 3] = SHIFT
    return similarity


def there(places: torch.Tensor) -> np.ndarray:
    return (places @ (SCALE * TURN).T + SHIFT).numpy()


def lay_down(vertices: np.ndarray) -> np.ndarray:
    """Vertices of a GLB file, in which y is up by a turn about their middle, in the photos' frame."""
    z_up = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    return (z_up - z_up.mean(0)) @ TURN.T.numpy() + z_up.mean(0)


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj", ".stl"])
def test_build_mesh_file_is_in_source_frame(suffix: str):
    run = make_ball_run(to_source())
    shape = build_mesh_file(run, run.orbit, sample_volume(run, RESOLUTION), None, suffix)
    assert "watertight" in shape.description
    mesh = trimesh.load(io.BytesIO(shape.content), file_type=suffix.removeprefix("."), force="mesh")
    vertices = np.asarray(mesh.vertices)
    if suffix == ".glb":
        vertices = lay_down(vertices)
    cell = SCALE * 2 / RESOLUTION
    radius = np.linalg.norm(vertices - there(CENTER), axis=1)
    assert np.percentile(np.abs(radius - SCALE * RADIUS), 95) < 1.5 * cell
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * (SCALE * RADIUS) ** 3, rel=0.2)
    if suffix == ".stl":
        return  # the format has no colors
    red, blue = mesh.visual.vertex_colors[:, 0], mesh.visual.vertex_colors[:, 2]
    height = (vertices @ TURN.numpy())[:, 2]
    top, bottom = height.argmax(), height.argmin()
    assert red[top] > 240 > 20 > blue[top] and blue[bottom] > 240 > 20 > red[bottom], "seen from outside"


def read_vertices(suffix: str, shift: torch.Tensor) -> np.ndarray:
    """Vertices as another library reads them."""
    run = make_ball_run(to_source())
    run.to_source[:3, 3] += shift
    volume = sample_volume(run, RESOLUTION)
    if suffix == "points":
        shape, suffix = build_points_file(run, run.orbit, volume, None), ".ply"
    else:
        shape = build_mesh_file(run, run.orbit, volume, None, suffix)
    loaded = trimesh.load(io.BytesIO(shape.content), file_type=suffix.removeprefix("."), process=False)
    return np.asarray(loaded.to_mesh().vertices if isinstance(loaded, trimesh.Scene) else loaded.vertices)


@pytest.mark.parametrize("suffix", [".ply", "points", ".obj", ".glb"])
def test_build_mesh_file_georeferenced_vertices_keep_precision(suffix: str):
    """In UTM coordinates single precision would leave steps of half a meter."""
    near, far = read_vertices(".ply", torch.zeros(3)), read_vertices(suffix, UTM)
    far = (lay_down(far) if suffix == ".glb" else far) - UTM.numpy()
    size = np.ptp(near, axis=0).max()
    for some, others in ((near, far), (far, near)):
        assert cKDTree(some).query(others)[0].max() < 1e-6 * size


def test_build_mesh_file_georeferenced_stl_raises():
    with pytest.raises(InputError, match=r"found .stl for coordinates up to 5.4112e\+06"):
        read_vertices(".stl", UTM)


def test_sample_volume_georeferenced_box_crops_cells():
    run = make_ball_run(to_source())
    near = sample_volume(run, RESOLUTION, box := torch.tensor([[4.99, -1.005, 1.99], [5.006, -0.992, 2.01]]).double())
    run.to_source[:3, 3] += UTM
    far = sample_volume(run, RESOLUTION, box + UTM)
    torch.testing.assert_close(far.low, near.low, atol=1e-6, rtol=0)
    torch.testing.assert_close(far.density, near.density, atol=0.01, rtol=0)
    assert near.density.shape == (40, 33, 27), "the box, in cells of the scene"


def test_build_voxels_file_contains_density_color_and_transform():
    run = make_ball_run(to_source())
    with np.load(io.BytesIO(build_voxels_file(run, sample_volume(run, RESOLUTION)).content)) as file:
        density, rgb, place = file["density"], file["rgb"], file["to_source"]
    assert density.shape == (RESOLUTION,) * 3 and rgb.shape == (*density.shape, 3)
    index = np.argwhere(density * SCALE > MAX_DENSITY / 2)
    places = index @ place[:3, :3].T + place[:3, 3]
    np.testing.assert_allclose(places.mean(0), there(CENTER), atol=SCALE * 0.01)
    assert np.linalg.norm(places - there(CENTER), axis=1).max() < SCALE * (RADIUS + 0.01)
    assert density.max() * SCALE == pytest.approx(MAX_DENSITY, rel=0.01), "per unit of the photos' frame"


def test_sample_volume_box_has_finer_cells():
    run = make_ball_run(to_source())
    middle = there(CENTER)
    reach = 0.7 * SCALE
    box = torch.tensor(np.stack([middle - reach, middle + [reach, reach, 0]]), dtype=torch.float32)
    volume = sample_volume(run, RESOLUTION, box)
    assert volume.cell == pytest.approx(1.4 / RESOLUTION, rel=1e-4)
    mesh = trimesh.load(io.BytesIO(build_mesh_file(run, run.orbit, volume, 0.5, ".ply").content), file_type="ply")
    low, high = mesh.bounds
    cell = SCALE * volume.cell
    assert abs(high[2] - middle[2]) < cell and abs(low[2] - (middle[2] - SCALE * RADIUS)) < 1.5 * cell
    assert mesh.is_watertight, "closed where it was cut"


def test_sample_volume_box_outside_scene_raises():
    message = r"export: box: found \[-2.0.*expected something within \[4.98.* the scene's box"
    with pytest.raises(InputError, match=message):
        sample_volume(make_ball_run(to_source()), RESOLUTION, torch.tensor([[-2.0] * 3, [-1.0] * 3]))


def test_sample_volume_cells_are_cubic():
    run = make_ball_run(torch.eye(4))
    aabb = torch.tensor([[-1.0, -0.5, -0.26], [1.0, 0.5, 0.26]])
    run.system.field.bounds = replace(run.system.field.bounds, aabb=aabb, pixel_footprint=0.02)
    volume = sample_volume(run, 20)
    assert volume.density.shape == (20, 10, 6) and sample_volume(run).density.shape[0] == 80
    center = volume.index_to_world(torch.tensor([[9.5, 4.5, 2.5]]))[0]
    torch.testing.assert_close(center, torch.zeros(3), atol=1e-6, rtol=0)
