import json
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.dataset import Reading, Scene, load_blender, load_npz
from nerf_lightning.dataset.resize import area_resize
from nerf_lightning.errors import InputError

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
    """RGBA, 8x6; an OpenGL camera with identity rotation stands at (0, 0, 5): right is x, up is y, it looks along -z."""
    pose = np.eye(4)
    pose[2, 3] = 5.0
    images = make_images()
    write_split(tmp_path / "Toy", "train", images[:2], np.stack([pose, pose]))
    write_split(tmp_path / "Toy", "val", images[2:], pose[None])
    return tmp_path / "Toy"


def test_plain_folder(folder: Path):
    scene = load_blender(folder)
    expected = make_images()
    assert (scene.train.images.numpy() == expected[:2]).all() and (scene.val.images.numpy() == expected[2:]).all()
    assert scene.name == "toy" and scene.resolution == (8, 6) and scene.background == (1.0, 1.0, 1.0)
    torch.testing.assert_close(scene.val.cameras.K[0], torch.tensor([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]]))
    assert len(scene.orbit) == 60 and not scene.bounds.unbounded


def test_a_known_point_is_seen_at_its_pixel(folder: Path):
    # (1.25, 0.75, 0) is 1.25 right of, 0.75 above and 5 before the camera: u = 4 + 2.5, v = 3 - 1.5, a pixel's centre.
    cameras = load_blender(folder).train.cameras
    ray = cameras.rays(torch.tensor([0]), torch.tensor([1]), torch.tensor([6]))
    point = torch.tensor([1.25, 0.75, 0.0])
    torch.testing.assert_close(ray.directions[0], torch.nn.functional.normalize(point - ray.origins[0], dim=0))
    torch.testing.assert_close(ray.origins[0], torch.tensor([0.0, 0.0, 5.0]))


def test_test_split_is_held_out_where_there_is_no_val(folder: Path):
    (folder / "transforms_val.json").rename(folder / "transforms_test.json")
    assert len(load_blender(folder).val) == 1


@pytest.mark.parametrize(("border", "background"), [(255, 1.0), (0, 0.0), (51, 0.2), (None, 0.0)])
def test_rgb_renders_with_borders_of_one_colour_are_bounded(border: int | None, background: float, folder: Path):
    random = np.random.default_rng(0).integers(0, 256, (1, 6, 8, 3), dtype=np.uint8)
    train = random if border is None else np.full_like(random, border)
    train[:, 2:4, 3:5] = 128
    write_split(folder, "train", train, np.eye(4)[None])
    write_split(folder, "val", np.full((1, 6, 8, 3), 9, np.uint8), np.eye(4)[None])
    scene = load_blender(folder, "named")
    assert scene.name == "named" and scene.train.images.shape == (1, 6, 8, 3)
    assert scene.background == pytest.approx((background,) * 3, abs=1e-6)
    assert scene.bounds.unbounded is (border is None)


def edit_all(folder: Path, **keys: object) -> None:
    for path in folder.glob("transforms_*.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), **keys}))


def test_intrinsics_in_pixels_go_before_the_angle_of_view(folder: Path):
    edit_all(folder, fl_x=11.0, fl_y=12.0, cx=3.5, cy=2.5, k1=-0.01, w=8, h=6)
    cameras = load_blender(folder).train.cameras
    torch.testing.assert_close(cameras.K[0], torch.tensor([[11.0, 0, 3.5], [0, 12, 2.5], [0, 0, 1]]))
    assert cameras.lenses.coefficients[0, 0] == pytest.approx(-0.01)
    edit_all(folder, camera_angle_x=None)
    torch.testing.assert_close(load_blender(folder).train.cameras.K, cameras.K)


def test_a_split_without_photos_is_a_camera_path(folder: Path):
    poses = np.stack([np.eye(4)] * 3)
    poses[:, 2, 3] = 3, 4, 5
    write_split(folder, "test", np.zeros((3, 6, 8, 4), np.uint8), poses)
    for file in (folder / "test").iterdir():
        file.unlink()
    scene = load_blender(folder)
    assert scene.test is None and scene.orbit.c2w[:, 2, 3].tolist() == [3, 4, 5]
    assert scene.orbit.size(0) == (8, 6)


def test_test_photos_beside_val_are_kept_apart(folder: Path):
    write_split(folder, "test", make_images(), np.stack([np.eye(4)] * 3))
    scene = load_blender(folder)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (2, 1, 3)


def test_some_training_photos_are_held_out_where_no_others_are_there(folder: Path, caplog: pytest.LogCaptureFixture):
    (folder / "transforms_val.json").unlink()
    scene = load_blender(folder)
    assert (len(scene.train), len(scene.val)) == (1, 1) and "no held-out photos" in caplog.text


def test_renders_of_several_sizes(folder: Path):
    imageio.imwrite(folder / "train" / "r_1.png", np.full((12, 16, 4), 7, np.uint8))
    cameras = load_blender(folder).train.cameras
    assert cameras.sizes.tolist() == [[8, 6], [16, 12]]
    assert cameras.K[:, 0, 0].tolist() == [10, 20], "the angle of view is the same"


def test_resize_never_enlarges(folder: Path):
    assert load_blender(folder, reading=Reading(resize=100)).resolution == (8, 6)


def test_resize_leaves_no_dark_rim():
    """White under alpha 1, black under alpha 0: every pixel with any alpha must stay white."""
    x, y = np.meshgrid(np.arange(50), np.arange(50))
    disc = ((x - 25) ** 2 + (y - 22) ** 2 < 300)[..., None]
    image = np.where(disc, 255, 0).astype(np.uint8).repeat(4, axis=2)
    small = area_resize(image, 19, 19)
    partial = (small[..., 3] > 0) & (small[..., 3] < 255)
    assert partial.sum() > 20
    assert (small[partial][:, :3] == 255).all()
    assert abs(small[..., 3].mean() - image[..., 3].mean()) < 1


def test_resize_then_composite_is_composite_then_resize(ball: Scene):
    rgba = ball.train.images[0].numpy()

    def over_white(image: np.ndarray) -> np.ndarray:
        alpha = image[..., 3:] / 255
        return np.rint(image[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)

    a, b = over_white(area_resize(rgba, 24, 20)), area_resize(over_white(rgba), 24, 20)
    assert np.abs(a.astype(int) - b).max() <= 1


def _edit(split: str, change: Callable[[dict], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / f"transforms_{split}.json"
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return apply


def _frame(key: str, value: object) -> Callable[[Path], None]:
    return _edit("train", lambda c: c["frames"][1].__setitem__(key, value))


def _write(name: str, content: bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(content)


def _angle(value: object) -> Callable[[Path], None]:
    return _edit("val", lambda c: c.update(camera_angle_x=value))


def _matrix(value: object) -> Callable[[Path], None]:
    return _frame("transform_matrix", value)


def _without(key: str) -> Callable[[Path], None]:
    return _edit("train", lambda c: c["frames"][1].pop(key))


MATRIX = "frames[1].transform_matrix: found"
DAMAGE = {
    "no train": (lambda f: (f / "transforms_train.json").unlink(), ["transforms_train.json: found nothing there"]),
    "broken json": (_write("transforms_train.json", b'{\n"frames":\n [}'), ["train.json: found broken JSON at line 3"]),
    "json list": (_write("transforms_val.json", b"[]"), ["transforms_val.json: found a JSON list"]),
    "not utf-8": (_write("transforms_val.json", b'{"\xff"}'), ["found something unreadable (Unicode"]),
    "angle missing": (
        _edit("val", lambda c: c.pop("camera_angle_x")),
        ["val.json: fl_x", "among [file_path, frames, "],
    ),
    "angle zero": (_angle(0), ["camera_angle_x: found 0, expected radians"]),
    "angle huge": (_angle(3.2), ["camera_angle_x: found 3.2"]),
    "angle of nothing": (_angle(1e-300), ["camera_angle_x: found 1e-300, expected the angle that a photo shows"]),
    "angle text": (_angle("wide"), ["camera_angle_x: found 'wide'"]),
    "angle endless": (_angle(10**400), ["a whole number of 401 digits"]),
    "frames missing": (_edit("train", lambda c: c.pop("frames")), ["frames: found no such key"]),
    "frames empty": (_edit("train", lambda c: c.update(frames=[])), ["frames: found an empty list"]),
    "frames object": (_edit("train", lambda c: c.update(frames={})), ["frames: found something else"]),
    "path missing": (_without("file_path"), ["frames[1]: file_path: found no such"]),
    "path number": (_frame("file_path", 3), ["frames[1].file_path: found 3"]),
    "matrix missing": (_without("transform_matrix"), ["frames[1]: transform_matrix: found no", "among [file_path]"]),
    "matrix shape": (_matrix(np.eye(3).tolist()), [f"{MATRIX} shape (3, 3)"]),
    "matrix ragged": (_matrix([[1, 2], [3]]), [f"{MATRIX} no matrix"]),
    "matrix text": (_matrix("identity"), [f"{MATRIX} no matrix"]),
    "matrix nan": (_matrix([[float("nan")] * 4] * 4), [f"{MATRIX} nan"]),
    "matrix scaled": (_matrix(np.diag([1.5, 1.5, 1.4, 1]).tolist()), [f"{MATRIX} R^T R", "scale"]),
    "matrix mirrored": (_matrix(np.diag([1.0, 1, -1, 1]).tolist()), [f"{MATRIX} a mirror", "handedness"]),
    "images missing": (
        _edit("train", lambda c: [f.update(file_path=f"r_{7 + i}") for i, f in enumerate(c["frames"])]),
        ["frames[0].file_path: found 'r_7', which is not there (nor are 1 more)"],
    ),
    "image text": (_write("train/r_0.png", b"no"), ["r_0.png: found 2 bytes that are no image"]),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage(damage: str, folder: Path, says: Callable):
    spoil, words = DAMAGE[damage]
    spoil(folder)
    with pytest.raises(InputError) as caught:
        load_blender(folder)
    says(caught.value, folder, *words, ", expected ")


@pytest.mark.real_data
def test_lego_is_the_same_scene_in_both_formats(real_data: Path):
    blender = load_blender(real_data / "nerf_synthetic" / "lego", reading=Reading(resize=200))
    course = load_npz(real_data / "lego_200x200.npz")
    assert (blender.name, len(blender.train), len(blender.val)) == ("lego", 100, 10)
    for split in ("train", "val"):
        ours, theirs = getattr(blender, split), getattr(course, split)
        for view in (0, len(ours) - 1):
            a, b = ours.cameras.view_rays(view), theirs.cameras.view_rays(view)
            torch.testing.assert_close(a.origins, b.origins, atol=1e-4, rtol=0)
            torch.testing.assert_close(a.directions, b.directions, atol=1e-4, rtol=0)
        rgba, rgb = ours.images[::10].float(), theirs.images[::10].float()
        assert (rgba[..., :3] * rgba[..., 3:] / 255 - rgb).abs().mean() < 0.5
