"""Photos of several sizes, and masks."""

import logging
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.dataset import RayDataModule, Scene, Views, open_scene
from nerf_lightning.dataset.photo_loading import PhotoLoadOptions
from nerf_lightning.dataset.ray_datamodule import make_batch
from nerf_lightning.errors import InputError
from tests.helpers.scene_writers import colmap_cameras, write_colmap, write_photos


@pytest.fixture(scope="session")
def views(ball_views_of: Callable[..., Views]) -> Views:
    return ball_views_of(6)


def mixed() -> Views:
    """Three sizes; each pixel has a unique color."""
    sizes = torch.tensor([[4, 3], [2, 5], [7, 1]])
    K = torch.eye(3).repeat(3, 1, 1)
    K[:, :2, 2] = sizes / 2
    pixels = torch.arange(29 * 3).to(torch.uint8).view(29, 3)
    return Views(pixels, Cameras(K, torch.eye(4).repeat(3, 1, 1), sizes))


def test_views_several_sizes_are_stored_without_padding():
    views = mixed()
    assert [tuple(views.image(i).shape) for i in range(3)] == [(3, 4, 3), (5, 2, 3), (1, 7, 3)]
    assert torch.equal(torch.cat([views.image(i).reshape(-1, 3) for i in range(3)]), views.pixels)
    assert views.nbytes == 29 * 3, "no padding"
    some = views[torch.tensor([2, 0])]
    assert torch.equal(some.image(0), views.image(2)) and torch.equal(some.image(1), views.image(0))
    following = views[torch.tensor([1, 2])]
    assert torch.equal(following.image(1), views.image(2))
    assert following.pixels.data_ptr() == views.image(1).data_ptr(), "no copy"


def test_make_batch_several_sizes_match_their_colors():
    views = mixed()
    batch = make_batch(views, views.sample_pixels(2000, torch.Generator().manual_seed(0)))
    directions = torch.cat([views.cameras.generate_view_rays(view).directions for view in range(3)])
    number = (batch.pixels[:, None] == views.pixels).all(2).int().argmax(1)
    torch.testing.assert_close(batch.rays.directions, directions[number])
    counts = torch.bincount(number, minlength=29)
    assert len(counts) == 29 and float(((counts - 2000 / 29) ** 2 * 29 / 2000).sum()) < 28 + 5 * 56**0.5, "chi squared"


def test_ray_data_held_out_masked_view_has_valid_mask():
    views = mixed()
    known = torch.ones(29, dtype=torch.bool)
    known[3:9], known[11:13], known[22:] = False, False, False
    views = Views(views.pixels, views.cameras, known)
    assert torch.equal(views[torch.tensor([1])].view_mask(0), views.view_mask(1))
    scene = Scene("mixed", "test", views, views, views.cameras, Bounds(torch.tensor([[-1.0] * 3, [1.0] * 3])))
    batch = RayDataModule(scene).get_held_out_view(1)
    assert (batch.width, batch.height) == (2, 5) and torch.equal(batch.valid_mask, known[12:22])


def capture(folder: Path, views: Views, background: int | None = None) -> Path:
    """A COLMAP capture whose photos are RGB on gray noise, or on one gray."""
    rng = np.random.default_rng(0)
    rgb = []
    for i in range(len(views)):
        image = views.image(i).numpy()
        alpha = image[..., 3:] / 255
        noise = rng.integers(0, 255, image.shape[:2])[..., None] if background is None else background
        rgb.append(np.rint(image[..., :3] * alpha + noise * (1 - alpha)).astype(np.uint8))
    names = write_photos(folder / "images", Views.from_images(torch.from_numpy(np.stack(rgb)), views.cameras))
    write_colmap(folder / "sparse/0", views.cameras.c2w.numpy(), names, colmap_cameras(views))
    return folder


def write_masks(folder: Path, views: Views, ending: str = ".png", side: int = 1) -> None:
    """White where the ball is."""
    folder.mkdir(exist_ok=True)
    for i in range(len(views)):
        mask = (views.image(i)[..., 3] > 127).numpy().astype(np.uint8) * 255
        imageio.imwrite(folder / f"{i:04d}{ending}", mask.repeat(side, 0).repeat(side, 1))


@pytest.mark.parametrize("ending", [".png.png", "-removebg-preview.png"])
def test_open_scene_mask_folder_is_read(ending: str, views: Views, tmp_path: Path):
    folder = capture(tmp_path, views)
    write_masks(folder / "masks", views, ending)
    scene = open_scene(str(folder))
    assert scene.train.channels == 3
    assert torch.equal(scene.train.view_mask(0), views.image(1)[..., 3] > 127)
    imageio.imwrite(folder / "masks" / f"0001{ending.replace('.png', '.PNG')}", np.zeros((40, 48), np.uint8))
    with pytest.raises(InputError, match="2 masks for 0001.png"):
        open_scene(str(folder))


def write_subfolders(folder: Path, views: Views, masked: tuple[str, ...]) -> Path:
    """Two cameras with equal photo names in separate folders; masks remove column 5 or 9."""
    columns = {"front": 5, "back": 9}
    names = []
    for camera, column in columns.items():
        for i in range(len(views) // 2):
            names.append(f"{camera}/{i:04d}.png")
            image = np.random.default_rng(i).integers(0, 255, (40, 48, 3), dtype=np.uint8)
            (folder / "images" / camera).mkdir(parents=True, exist_ok=True)
            imageio.imwrite(folder / "images" / names[-1], image)
            if camera in masked:
                mask = np.full((40, 48), 255, np.uint8)
                mask[:, column] = 0
                (folder / "masks" / camera).mkdir(parents=True, exist_ok=True)
                imageio.imwrite(folder / "masks" / names[-1], mask)
    write_colmap(folder / "sparse/0", views.cameras.c2w.numpy(), names, colmap_cameras(views))
    return folder


def test_open_scene_masks_in_subfolders_match_their_photos(views: Views, tmp_path: Path):
    scene = open_scene(str(write_subfolders(tmp_path / "both", views, ("front", "back"))))
    for view, name in enumerate(scene.train.names):
        hidden = 9 if name.startswith("back") else 5
        assert (~scene.train.view_mask(view)).nonzero()[:, 1].unique().tolist() == [hidden], name
    half = open_scene(str(write_subfolders(tmp_path / "half", views, ("front",))))
    hidden = {name.split("/")[0]: int((~half.train.view_mask(i)).sum()) for i, name in enumerate(half.train.names)}
    assert hidden == {"back": 0, "front": 40}, "the other camera's masks are not taken"


def test_open_scene_masks_over_uniform_color_cut_out(views: Views, tmp_path: Path):
    folder = capture(tmp_path, views, background=255)
    write_masks(folder / "images_mask", views)
    assert open_scene(str(folder)).train.channels == 4, "these photos are cut out already"
    assert open_scene(str(folder), options=PhotoLoadOptions(masked="ignore")).train.channels == 3


def test_open_scene_mask_options_are_followed(views: Views, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    folder = capture(tmp_path, views)
    write_masks(folder / "masks", views, side=2)
    chosen = PhotoLoadOptions(), PhotoLoadOptions(invert_masks=True), PhotoLoadOptions(masked="background")
    straight, turned, empty = (open_scene(str(folder), options=options) for options in chosen)
    assert "are they inverted? Set dataset.invert_masks=false if so" in caplog.text
    kept = views.image(1)[..., 3] > 127
    assert torch.equal(straight.train.view_mask(0), kept) and torch.equal(turned.train.view_mask(0), ~kept)
    assert empty.train.channels == 4 and empty.train.valid_mask is None and not empty.bounds.unbounded
    assert torch.equal(empty.train.image(0)[..., 3], (kept * 255).to(torch.uint8))


def test_open_scene_fully_masked_view_is_not_held_out(views: Views, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    folder = capture(tmp_path, views)
    write_masks(folder / "masks", views)
    imageio.imwrite(folder / "masks" / "0008.png", np.zeros((40, 48), np.uint8))
    with caplog.at_level(logging.WARNING):
        assert len(open_scene(str(folder)).val) == 2
    assert "1 fully masked photos ignored" in caplog.text


def test_open_scene_several_sizes_keep_their_rays(views: Views, tmp_path: Path):
    """Crops of several sizes have the rays of the full photos."""
    names = write_photos(tmp_path / "images", views)
    cameras = colmap_cameras(views)
    for i in range(0, len(names), 2):
        image = imageio.imread(tmp_path / "images" / names[i])
        imageio.imwrite(tmp_path / "images" / names[i], image[4:-3, 10:-12])
        model, _, _, (fx, fy, cx, cy) = cameras[i + 1]
        cameras[i + 1] = (model, 26, 33, (fx, fy, cx - 10, cy - 4))
    write_colmap(tmp_path / "sparse/0", views.cameras.c2w.numpy(), names, cameras)
    scene = open_scene(str(tmp_path))
    assert scene.resolution == (48, 40)
    whole = views.cameras.generate_view_rays(2).directions.view(40, 48, 3)[4:-3, 10:-12].reshape(-1, 3)
    expected = torch.nn.functional.normalize(whole @ torch.linalg.inv(scene.to_source[:3, :3]).float().T, dim=1)
    torch.testing.assert_close(scene.train.cameras.generate_view_rays(1).directions, expected, atol=1e-5, rtol=0)


def test_open_scene_too_many_photos_raise(views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = capture(tmp_path, views)

    class Memory:
        available = 17 * 48 * 40 * 3  # one photo less

    monkeypatch.setattr("psutil.virtual_memory", Memory)
    with pytest.raises(InputError, match="give a smaller dataset.resize"):
        open_scene(str(folder))
    assert open_scene(str(folder), options=PhotoLoadOptions(resize=42)).train.cameras.size(0) == (42, 35)
