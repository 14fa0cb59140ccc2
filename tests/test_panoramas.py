"""Equirectangular photos of a room: reading, training with pose refinement, export."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

import nerf_lightning as nl
from nerf_lightning.cameras import Bounds, Cameras, Rays, look_at, make_circle_poses
from nerf_lightning.dataset import RayDataModule, Scene, Views, load_transforms
from nerf_lightning.export.compress import compress_system
from nerf_lightning.export.mesh import build_mesh_file
from nerf_lightning.export.transforms import write_photos
from nerf_lightning.export.volume import sample_volume
from nerf_lightning.export.web_page import render_field_page
from nerf_lightning.runs.folder import config_to_dict
from nerf_lightning.runs.open import open_run
from nerf_lightning.synthetic.objects import trace_rays
from nerf_lightning.synthetic.rooms import make_subject, make_walls
from nerf_lightning.utils.device import CPU
from tests.cameras.test_equirectangular import panoramas
from tests.helpers.ball_runs import CENTER, RADIUS, make_ball_run

WIDTH, HEIGHT, STEPS = 64, 32, 80
ROOM = [*make_subject(0.5, 2.0), *make_walls(3.0, -0.5, 2.5, 0.6, 0.8)]
UP = torch.tensor([0.0, 0.0, 1.0])


def sample_poses(count: int, seed: int) -> torch.Tensor:
    """Level cameras at random positions around the pile, with random azimuths."""
    generator = torch.Generator().manual_seed(seed)
    turn, radius, height, heading = torch.rand(4, count, generator=generator)
    turn, heading = 2 * math.pi * turn, 2 * math.pi * heading
    eye = torch.stack([turn.cos() * (1.0 + radius), turn.sin() * (1.0 + radius), 0.2 + height], dim=1)
    return look_at(eye, eye + torch.stack([heading.cos(), heading.sin(), 0 * heading], dim=1), UP)


def render_photos(c2w: torch.Tensor) -> torch.Tensor:
    """Equirectangular photos by the definition of the projection: bytes."""
    longitude = ((torch.arange(2 * WIDTH) + 0.5) / (2 * WIDTH) - 0.5) * 2 * math.pi
    latitude = ((torch.arange(2 * HEIGHT) + 0.5) / (2 * HEIGHT) - 0.5)[:, None] * math.pi
    right, down, ahead = longitude.sin() * latitude.cos(), latitude.sin(), longitude.cos() * latitude.cos()
    local = torch.stack([right, down.expand_as(right), ahead], dim=2).view(-1, 3)
    colors, _, _ = trace_rays(ROOM, Rays(c2w[:3, 3].expand_as(local), local @ c2w[:3, :3].T))
    return (colors.view(HEIGHT, 2, WIDTH, 2, 3).mean((1, 3)).clamp(0, 1) * 255).round().to(torch.uint8)


def render_views(count: int, seed: int) -> Views:
    cameras = panoramas(sample_poses(count, seed), WIDTH, HEIGHT)
    return Views.from_images(torch.stack([render_photos(c2w) for c2w in cameras.c2w]), cameras)


@pytest.fixture(scope="module")
def scene() -> Scene:
    train, val = render_views(16, 0), render_views(3, 1)
    lens = train.cameras[0].to_pinhole()
    circle = make_circle_poses(torch.zeros(3), UP, 1.5, 0.4, 4)
    orbit = Cameras.pinhole(lens.K.repeat(4, 1, 1), circle, lens.width, lens.height)
    bounds = Bounds(torch.tensor([[-3.2, -3.2, -0.7], [3.2, 3.2, 2.2]]))
    return Scene("room", "built-in", train, val, orbit, bounds)


def test_panoramas_room_trains_and_exports(scene: Scene, tmp_path: Path):
    mean = scene.train.pixels.float().mean(0)
    plain = -10 * math.log10(float(((scene.val.pixels.float() - mean) / 255).square().mean()))
    options = ["model=tensorf", "refine=both", "sampler.samples=48", "sampler.resolution=16", "~logger"]
    options += ["callbacks.snapshots=null", "callbacks.orbit.frames=2", "callbacks.validation.fractions=[]"]
    options += ["dataset.samples=8192"]
    run = nl.train(scene, steps=STEPS, device="cpu", folder=tmp_path / "run", options=options)
    assert run.psnr > plain + 6
    found, data = open_run(run.path, CPU), RayDataModule(scene)
    compact = compress_system(found.system, data, config_to_dict(found.cfg), 3.0)
    assert compact.psnr > plain + 5
    cameras = scene.train.cameras
    page = render_field_page(compact.content, run.system, scene.orbit, "room", [], cameras, [str(i) for i in range(16)])
    photos = json.loads(page.split('id="about">')[1].split("</script>")[0])["photos"]
    assert photos["lenses"] == [[20, 15, *cameras.to_pinhole().K[0, [0, 1, 0, 1], [0, 1, 2, 2]].tolist()]]


def test_mesh_from_panoramas_sees_all_directions():
    run = make_ball_run(torch.eye(4, dtype=torch.float64))
    around = make_circle_poses(CENTER, UP, 3.0, 0.6, 6)
    away = torch.diag(torch.tensor([-1.0, 1, -1, 1]))  # the ball lies on the seam of half of them
    c2w = torch.cat([around, make_circle_poses(CENTER, UP, 3.0, -0.6, 6) @ away])
    shape = build_mesh_file(run, panoramas(c2w, 160, 80), sample_volume(run, 32), None, ".ply")
    assert "watertight" in shape.description and "floating" not in shape.description
    vertices = np.frombuffer(
        shape.content.split(b"end_header\n")[1], np.dtype([("v", "<f8", 3), ("rgb", "u1", 3)]), 100
    )["v"]
    assert np.abs(np.linalg.norm(vertices - CENTER.numpy(), axis=1) - RADIUS).max() < 0.1


def test_write_photos_panoramas_name_projection(scene: Scene, tmp_path: Path):
    write_photos(scene, tmp_path)
    frame = json.loads((tmp_path / "transforms.json").read_text())["frames"][0]
    assert frame["camera_model"] == "EQUIRECTANGULAR" and (frame["w"], frame["h"]) == (WIDTH, HEIGHT)
    assert [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")] == [HEIGHT, HEIGHT, WIDTH / 2, HEIGHT / 2]
    again = load_transforms(tmp_path)
    turns = [one.to_source[:3, :3] / torch.linalg.det(one.to_source[:3, :3]) ** (1 / 3) for one in (again, scene)]
    rays = [one.train.cameras.generate_view_rays(1).directions for one in (again, scene)]
    directions = [ray @ turn.float().T for ray, turn in zip(rays, turns, strict=True)]
    torch.testing.assert_close(*directions, atol=1e-5, rtol=0)
