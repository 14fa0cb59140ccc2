"""Surfaces of solids whose shape is known."""

import numpy as np
import pytest
import torch
import trimesh

from nerf_lightning.errors import InputError
from nerf_lightning.export.surface import find_surface, otsu
from nerf_lightning.export.volume import Volume

N, CELL, SOFT, DENSE = 40, 0.05, 0.02, 60.0
LOW = torch.tensor([-1.0, -1.0, -1.0])


def volume(*balls: tuple[tuple[float, float, float], float], hollow: float = 0.0) -> Volume:
    """Balls (centre, radius) that are dense, softly at their skin; the first one empty again around its centre."""
    empty = Volume(torch.zeros(N, N, N), LOW, CELL)
    places = empty.places(torch.stack(torch.meshgrid(*[torch.arange(N)] * 3, indexing="ij"), -1).float())
    depth = torch.stack([radius - (places - torch.tensor(centre)).norm(dim=-1) for centre, radius in balls]).amax(0)
    density = DENSE * torch.sigmoid(depth / SOFT)
    density[(places - torch.tensor(balls[0][0])).norm(dim=-1) < hollow] = 0
    return Volume(density, LOW, CELL)


def mesh_of(one: Volume, threshold: float | None = None) -> trimesh.Trimesh:
    surface = find_surface(one, threshold)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    away = surface.vertices - surface.vertices.mean(0)
    assert (np.einsum("ij,ij->i", away, surface.normals) > 0).mean() > 0.99, "normals point outwards"
    return mesh


@pytest.mark.parametrize("hollow", [0.0, 0.4])
def test_a_ball_is_round_closed_and_full(hollow: float):
    mesh = mesh_of(volume(((0.1, 0.0, -0.2), 0.7), hollow=hollow), 0.5)
    radius = np.linalg.norm(mesh.vertices - [0.1, 0.0, -0.2], axis=1)
    share = -np.log(0.5) / (DENSE * CELL)  # of the full density where a cell's opacity is one half
    expected = 0.7 - SOFT * np.log(share / (1 - share))
    assert mesh.is_watertight
    assert np.abs(radius - expected).max() < CELL / 2, "of a hollow one the outside alone"
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * expected**3, rel=0.03), "triangles face outwards"


def test_small_pieces_float_and_are_left_out_but_others_stay():
    one = volume(((-0.3, 0, 0), 0.5), ((0.7, 0.7, 0.7), 0.05), ((0.6, 0, 0), 0.25))
    surface = find_surface(one, 0.5)
    assert surface.floaters == 1
    assert trimesh.Trimesh(surface.vertices, surface.faces).body_count == 2


def test_what_the_box_cuts_is_closed_there():
    mesh = mesh_of(volume(((0.0, 0.0, -1.0), 0.8)), 0.5)
    assert mesh.is_watertight
    assert mesh.bounds[0, 2] >= -1.0 - CELL


def test_the_threshold_stands_between_the_thin_and_the_dense():
    generator = np.random.default_rng(0)
    thin, dense = generator.normal(0.15, 0.03, 4000), generator.normal(0.9, 0.02, 1000)
    assert 0.3 < otsu(np.concatenate([thin, dense]).clip(0, 1)) < 0.8
    assert otsu(np.zeros(0)) == 0.5
    fog = volume(((0, 0, 0), 0.5))
    fog.density[fog.density < 1] = 1.5  # a haze all over the box
    mesh = mesh_of(fog)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.5).max() < 2 * CELL


def test_nothing_there_is_told():
    with pytest.raises(InputError, match="nothing above an opacity of 0.90 a cell, expected at most 0.00"):
        find_surface(Volume(torch.zeros(4, 4, 4), LOW, CELL), 0.9)
    with pytest.raises(InputError, match="threshold: found 1.5, expected between 0 and 1"):
        find_surface(volume(((0, 0, 0), 0.5)), 1.5)
