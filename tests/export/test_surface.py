"""Surfaces of solids whose shape is known."""

import numpy as np
import pytest
import torch
import trimesh

from nerf_lightning.errors import InputError
from nerf_lightning.export.surface import (
    compute_otsu_threshold,
    extract_surface,
    fill_bounding_box,
    find_unoccluded_cells,
)
from nerf_lightning.export.volume import Volume, sample_volume
from tests.helpers.ball_runs import CENTER, RADIUS, make_ball_run

N, CELL, SOFT, DENSE = 40, 0.05, 0.02, 60.0
LIT = np.ones((N, N, N), bool)
LOW = torch.tensor([-1.0, -1.0, -1.0])


def volume(*balls: tuple[tuple[float, float, float], float]) -> Volume:
    """Balls (center, radius) that are dense, softly at their skin."""
    empty = Volume(torch.zeros(N, N, N), LOW, CELL)
    depth = torch.stack(
        [radius - (empty.centers - torch.tensor(center)).norm(dim=-1) for center, radius in balls]
    ).amax(0)
    density = DENSE * torch.sigmoid(depth / SOFT)
    return Volume(density, LOW, CELL)


def mesh_of(one: Volume, threshold: float | None = None) -> trimesh.Trimesh:
    surface = extract_surface(one, LIT, threshold)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    away = surface.vertices - surface.vertices.mean(0)
    assert (np.einsum("ij,ij->i", away, surface.normals) > 0).mean() > 0.99, "normals point outwards"
    return mesh


def test_extract_surface_ball_is_watertight():
    mesh = mesh_of(volume(((0.1, 0.0, -0.2), 0.7)), 0.5)
    radius = np.linalg.norm(mesh.vertices - [0.1, 0.0, -0.2], axis=1)
    share = -np.log(0.5) / (DENSE * CELL)  # of the full density where a cell's opacity is one half
    expected = 0.7 - SOFT * np.log(share / (1 - share))
    assert mesh.is_watertight
    assert np.abs(radius - expected).max() < CELL / 2
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * expected**3, rel=0.05), "triangles face outwards"


def test_extract_surface_removes_only_floaters():
    one = volume(((-0.3, 0, 0), 0.5), ((0.7, 0.7, 0.7), 0.05), ((0.6, 0, 0), 0.25))
    surface = extract_surface(one, LIT, 0.5)
    assert surface.floaters == 1
    assert trimesh.Trimesh(surface.vertices, surface.faces).body_count == 2


def test_compute_otsu_threshold_separates_haze_from_solid():
    generator = np.random.default_rng(0)
    thin, dense = generator.normal(0.15, 0.03, 4000), generator.normal(0.9, 0.02, 1000)
    assert 0.3 < compute_otsu_threshold(np.concatenate([thin, dense]).clip(0, 1)) < 0.8
    blurred = generator.uniform(0.1, 0.9, 1500)
    haze = generator.uniform(0.02, 0.08, 40000)
    assert 0.3 < compute_otsu_threshold(np.concatenate([haze, blurred, dense]).clip(0, 1)) < 0.8, "not within the haze"
    assert compute_otsu_threshold(np.zeros(0)) == 0.5 and compute_otsu_threshold(np.full(3, 0.6)) == 0.3
    assert compute_otsu_threshold(np.array([0.2, 0.2, 0.8])) == pytest.approx(0.5)
    fog = volume(((0, 0, 0), 0.5))
    fog.density.clamp_(min=0.3)  # a haze all over the box, which stops a quarter of the light on its way to the middle
    mesh = mesh_of(fog)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.5).max() < 2 * CELL


def test_extract_surface_empty_volume_raises():
    with pytest.raises(InputError, match="nothing above an opacity of 0.90 a cell, expected at most 0.00"):
        extract_surface(Volume(torch.zeros(N, N, N), LOW, CELL), LIT, 0.9)


def test_extract_surface_occluded_cells_are_solid():
    run = make_ball_run(torch.eye(4))
    one = sample_volume(run, N)
    unoccluded = find_unoccluded_cells(run.system, one, run.orbit)
    radius = (one.centers - CENTER).norm(dim=-1).numpy()
    assert not unoccluded[radius < RADIUS - 2.5 * one.cell].any()
    in_view = unoccluded[(radius > RADIUS + 2 * one.cell) & (radius < RADIUS + 4 * one.cell)]
    assert in_view.mean() > 0.95
    hollow = Volume(torch.where(torch.from_numpy(radius) < RADIUS - 3 * one.cell, 0.0, one.density), one.low, one.cell)
    inside = extract_surface(hollow, unoccluded, 0.5)
    away = np.linalg.norm(inside.vertices - CENTER.numpy(), axis=1)
    assert (away > RADIUS - one.cell).all(), "its inner side stays unseen"


def test_extract_surface_occluded_cells_below_floor_stay_empty():
    floor = np.zeros((6, 6, 6), bool)
    floor[1:5, 1:5, 3] = True
    assert fill_bounding_box(floor).sum() == 16 and not fill_bounding_box(np.zeros((2, 2, 2), bool)).any()
