"""Posed photos in one frame, whatever frame they came in."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras import Cameras, orbit_around
from nerf_lightning.dataset import Reading, Views, open_scene
from nerf_lightning.dataset.formats.header import stated_exposure
from nerf_lightning.dataset.posed import normalize_poses
from nerf_lightning.dataset.region import find_region
from tests.helpers.colmap_files import photos, write_transforms
from tests.helpers.exif_tags import tags

UP = torch.tensor([0.0, 0.0, 1.0])


@pytest.mark.parametrize("some", [slice(None), slice(0, 4)])
def test_normalize_poses_any_frame_is_turned_upright(some: slice):
    c2w = orbit_around(torch.zeros(3), UP, 2.0, 0.4, 12)[some].double()
    moved = torch.eye(4).double()
    moved[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix())
    moved[:3, 3] = torch.tensor([5.0, -3.0, 2.0])
    elsewhere = moved @ c2w
    elsewhere[:, :3, 3] *= 7
    found, to_source = normalize_poses(elsewhere, torch.arange(len(c2w)), find_region(elsewhere))
    torch.testing.assert_close(found[:, 2, 3], c2w[:, 2, 3] / 2, atol=1e-5, rtol=0)
    torch.testing.assert_close(found[:, :3, 3].norm(dim=1), torch.ones(len(c2w)).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(found[:, 2, 2], c2w[:, 2, 2], atol=1e-5, rtol=0)  # they look down as before
    back = to_source.double() @ found
    np.testing.assert_allclose(back[:, :3, 3], elsewhere[:, :3, 3], atol=1e-4)


def test_normalize_poses_held_out_do_not_move_the_frame():
    c2w = orbit_around(torch.zeros(3), UP, 2.0, 0.4, 12).double()
    far = c2w.clone()
    far[::4, :3, 3] += 30
    train = torch.tensor([i for i in range(12) if i % 4])
    found, to_source = normalize_poses(far, train, find_region(far[train]))
    torch.testing.assert_close(to_source, normalize_poses(c2w, train, find_region(c2w[train]))[1])
    torch.testing.assert_close(find_region(found[train]).centre, torch.zeros(3).double(), atol=1e-6, rtol=0)


def test_open_scene_walk_has_no_near(tmp_path: Path):
    """Only where all cameras look at one thing is it known that nothing is near."""
    walk = torch.eye(4).repeat(9, 1, 1)
    walk[:, 0, 3] = torch.linspace(-4, 4, 9)
    ring = orbit_around(torch.zeros(3), UP, 2.0, 0.4, 9)
    noise = torch.randint(0, 255, (9, 12, 16, 3), generator=torch.manual_seed(0)).to(torch.uint8)
    K = torch.tensor([[14.0, 0, 8], [0, 14, 6], [0, 0, 1]]).repeat(9, 1, 1)
    for name, c2w, near in (("walk", walk, None), ("ring", ring, 0.25)):
        views = Views.of(noise, Cameras.of_size(K, c2w, 16, 12))
        names = photos(tmp_path / name, views)
        write_transforms(tmp_path / name / "transforms.json", views, names, w=16, h=12)
        assert open_scene(str(tmp_path / name)).bounds.near == (near if near is None else pytest.approx(near))


@pytest.mark.parametrize("silent", [None, 3])
def test_open_scene_exposures_come_from_exif(silent: int | None, tmp_path: Path):
    K = torch.tensor([[14.0, 0, 8], [0, 14, 6], [0, 0, 1]]).repeat(9, 1, 1)
    c2w = orbit_around(torch.zeros(3), UP, 2.0, 0.4, 9)
    views = Views.of(torch.zeros(9, 12, 16, 3, dtype=torch.uint8), Cameras.of_size(K, c2w, 16, 12))
    names = photos(tmp_path, views, ".jpg")
    for i, name in enumerate(names):
        exif = tags(seconds=2.0**-i, aperture=2.0, speed=0 if i == silent else 100)
        Image.new("RGB", (16, 12)).save(tmp_path / name, exif=exif)
    write_transforms(tmp_path / "transforms.json", views, names, w=16, h=12)
    scene = open_scene(str(tmp_path), reading=Reading(holdout=4))
    stated = {name: 25 * 2.0**-i for i, name in enumerate(names)} if silent is None else {}
    for part in (scene.train, scene.val):
        assert part.exposures == pytest.approx(tuple(stated[name] for name in part.names if stated))
    assert stated_exposure(tmp_path / "transforms.json") is None
