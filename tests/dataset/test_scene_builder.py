"""World frame of scenes built from posed photos in any frame."""

from pathlib import Path

import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras import Cameras, look_at, make_circle_poses, transform_poses
from nerf_lightning.dataset import RayDataModule, Views, open_scene
from nerf_lightning.dataset.region import find_region
from nerf_lightning.dataset.scene_builder import make_region_frame
from nerf_lightning.runs.scene_file import parse_metadata, scene_to_dict
from tests.helpers.exif_tags import encode_exif
from tests.helpers.scene_writers import write_photos, write_transforms

UP = torch.tensor([0.0, 0.0, 1.0])
RING = make_circle_poses(torch.zeros(3), UP, 2.0, 0.4, 9)


def make_noise_views(c2w: torch.Tensor) -> Views:
    K = torch.tensor([[14.0, 0, 8], [0, 14, 6], [0, 0, 1]]).repeat(9, 1, 1)
    noise = torch.randint(0, 255, (9, 12, 16, 3), generator=torch.manual_seed(0)).to(torch.uint8)
    return Views.from_images(noise, Cameras.pinhole(K, c2w, 16, 12))


@pytest.mark.parametrize("some", [slice(None), slice(0, 4)])
def test_make_region_frame_any_frame_is_turned_upright(some: slice):
    c2w = make_circle_poses(torch.zeros(3), UP, 2.0, 0.4, 12)[some].double()
    moved = torch.eye(4).double()
    moved[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix())
    moved[:3, 3] = torch.tensor([5.0, -3.0, 2.0])
    elsewhere = moved @ c2w
    elsewhere[:, :3, 3] *= 7
    found = transform_poses(elsewhere, torch.linalg.inv(make_region_frame(elsewhere, find_region(elsewhere))))
    torch.testing.assert_close(found[:, 2, 3], c2w[:, 2, 3] / 2, atol=1e-5, rtol=0)
    torch.testing.assert_close(found[:, :3, 3].norm(dim=1), torch.ones(len(c2w)).double(), atol=1e-5, rtol=0)
    torch.testing.assert_close(found[:, 2, 2], c2w[:, 2, 2], atol=1e-5, rtol=0)  # they look down as before


def test_open_scene_walk_has_no_near(tmp_path: Path):
    """Only a common subject implies that nothing is near."""
    walk = torch.eye(4).repeat(9, 1, 1)
    walk[:, 0, 3] = torch.linspace(-4, 4, 9)
    for name, c2w, near in (("walk", walk, None), ("ring", RING, 0.25)):
        views = make_noise_views(c2w)
        names = write_photos(tmp_path / name, views)
        write_transforms(tmp_path / name / "transforms.json", views, names, w=16, h=12)
        assert open_scene(str(tmp_path / name)).bounds.near == (near if near is None else pytest.approx(near))


def test_open_scene_forward_cameras_get_a_core(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Around all cameras of a grid that look one way; not around a ring."""
    caplog.set_level("INFO")
    grid = torch.cartesian_prod(torch.arange(-1.0, 2), torch.arange(-1.0, 2), torch.zeros(1))
    forward = look_at(grid, torch.tensor([0.0, 0, 12]), torch.tensor([0.0, -1, 0]))
    for name, c2w, has_core in (("forward", forward, True), ("ring", RING, False)):
        views = make_noise_views(c2w)
        names = write_photos(tmp_path / name, views)
        write_transforms(tmp_path / name / "transforms.json", views, names, w=16, h=12)
        caplog.clear()
        scene = open_scene(str(tmp_path / name))
        core = scene.bounds.core
        assert (core is not None) == has_core == ("perspective and disparity" in caplog.text)
        if core is not None:
            assert ((scene.train.cameras.centers - core.mean(0)).abs() <= scene.bounds.near).all()
            assert float(core[1, 0] - core[0, 0]) / 2 == pytest.approx(scene.bounds.near)
            reloaded, _, _ = parse_metadata(scene_to_dict(RayDataModule(scene)), "made")
            assert torch.equal(reloaded.bounds.core, core)


def test_open_scene_exposures_come_from_exif(tmp_path: Path):
    views = make_noise_views(RING)
    names = write_photos(tmp_path, views, ".jpg")
    for i, name in enumerate(names):
        Image.new("RGB", (16, 12)).save(tmp_path / name, exif=encode_exif(seconds=2.0**-i, aperture=2.0, speed=100))
    write_transforms(tmp_path / "transforms.json", views, names, w=16, h=12)
    stated = {name: 25 * 2.0**-i for i, name in enumerate(names)}
    scene = open_scene(str(tmp_path))
    for part in (scene.train, scene.val):
        assert part.exposures == pytest.approx(tuple(stated[name] for name in part.names))
    Image.new("RGB", (16, 12)).save(tmp_path / names[3], exif=encode_exif(seconds=1.0, aperture=2.0, speed=0))
    assert open_scene(str(tmp_path)).train.exposures == (), "one of them does not say"
