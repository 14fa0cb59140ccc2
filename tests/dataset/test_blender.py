import json
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.dataset import PhotoLoadOptions, load_blender, load_npz
from nerf_lightning.dataset.resize import resize_area

ANGLE = 2 * float(np.arctan(0.5 * 8 / 10))  # focal 10 at 8 pixels width


def write_split(folder: Path, split: str, images: np.ndarray, c2w_opengl: np.ndarray) -> None:
    (folder / split).mkdir(parents=True, exist_ok=True)
    frames = []
    for i, (image, pose) in enumerate(zip(images, c2w_opengl, strict=True)):
        imageio.imwrite(folder / split / f"r_{i}.png", image)
        frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
    (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))


def make_images() -> np.ndarray:
    """Three RGBA images whose alpha cuts a subject out."""
    images = np.random.default_rng(0).integers(0, 256, (3, 6, 8, 4), dtype=np.uint8)
    images[:, [0, -1], :, 3] = images[:, :, [0, -1], 3] = 0
    return images


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """RGBA, 8x6; an OpenGL camera with identity rotation at (0, 0, 5): right is x, up is y, viewing along -z."""
    pose = np.eye(4)
    pose[2, 3] = 5.0
    images = make_images()
    write_split(tmp_path / "Toy", "train", images[:2], np.stack([pose, pose]))
    write_split(tmp_path / "Toy", "val", images[2:], pose[None])
    return tmp_path / "Toy"


def test_load_blender_plain_folder_returns_its_images(folder: Path):
    scene = load_blender(folder)
    expected = make_images()
    assert (scene.train.images.numpy() == expected[:2]).all() and (scene.val.images.numpy() == expected[2:]).all()
    assert scene.name == "toy" and scene.resolution == (8, 6) and scene.background == (1.0, 1.0, 1.0)
    torch.testing.assert_close(scene.val.cameras.K[0], torch.tensor([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]]))
    assert len(scene.orbit) == 60 and not scene.bounds.unbounded


def test_load_blender_pixel_intrinsics_precede_the_angle(folder: Path):
    for path in folder.glob("transforms_*.json"):
        keys = {"fl_x": 11.0, "fl_y": 12.0, "cx": 3.5, "cy": 2.5, "k1": -0.01, "w": 8, "h": 6}
        path.write_text(json.dumps({**json.loads(path.read_text()), **keys}))
    cameras = load_blender(folder).train.cameras
    torch.testing.assert_close(cameras.K[0], torch.tensor([[11.0, 0, 3.5], [0, 12, 2.5], [0, 0, 1]]))
    assert cameras.lenses.coefficients[0, 0] == pytest.approx(-0.01)


def test_load_blender_split_without_photos_is_the_orbit(folder: Path):
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 2, 3] = 3, 4, 5
    write_split(folder, "test", np.zeros((3, 6, 8, 4), np.uint8), poses)
    for file in (folder / "test").iterdir():
        file.unlink()
    scene = load_blender(folder)
    assert scene.test is None and scene.orbit.c2w[:, 2, 3].tolist() == [3, 4, 5]
    assert scene.orbit.size(0) == (8, 6)


def test_load_blender_splits_follow_the_files(folder: Path):
    """Test photos are separate from val, or held out instead of it; without both, some training photos are held out."""
    write_split(folder, "test", make_images(), np.stack([np.eye(4)] * 3))
    scene = load_blender(folder)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (2, 1, 3)
    (folder / "transforms_val.json").unlink()
    assert len(load_blender(folder).val) == 3
    (folder / "transforms_test.json").unlink()
    scene = load_blender(folder)
    assert (len(scene.train), len(scene.val)) == (1, 1)


def test_resize_area_alpha_leaves_no_dark_rim():
    """White under alpha 1, black under alpha 0: every pixel with any alpha must stay white."""
    x, y = np.meshgrid(np.arange(50), np.arange(50))
    disc = ((x - 25) ** 2 + (y - 22) ** 2 < 300)[..., None]
    image = np.where(disc, 255, 0).astype(np.uint8).repeat(4, axis=2)
    small = resize_area(image, 19, 19)
    partial = (small[..., 3] > 0) & (small[..., 3] < 255)
    assert partial.sum() > 20
    assert (small[partial][:, :3] == 255).all()
    assert abs(small[..., 3].mean() - image[..., 3].mean()) < 1


@pytest.mark.real_data
def test_open_scene_lego_is_equal_in_both_formats(real_data: Path):
    blender = load_blender(real_data / "nerf_synthetic" / "lego", options=PhotoLoadOptions(resize=200))
    course = load_npz(real_data / "lego_200x200.npz")
    assert (blender.name, len(blender.train), len(blender.val)) == ("lego", 100, 10)
    for split in ("train", "val"):
        ours, theirs = getattr(blender, split), getattr(course, split)
        for view in (0, len(ours) - 1):
            a, b = ours.cameras.generate_view_rays(view), theirs.cameras.generate_view_rays(view)
            torch.testing.assert_close(a.origins, b.origins, atol=1e-4, rtol=0)
            torch.testing.assert_close(a.directions, b.directions, atol=1e-4, rtol=0)
        rgba, rgb = ours.images[::10].float(), theirs.images[::10].float()
        assert (rgba[..., :3] * rgba[..., 3:] / 255 - rgb).abs().mean() < 0.5
