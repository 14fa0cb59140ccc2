import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import orbit_like
from nerf_lightning.dataset import Scene, load_npz, save_npz
from nerf_lightning.errors import InputError

Arrays = dict[str, np.ndarray]


def on_black(images: np.ndarray) -> np.ndarray:
    """Images with a black border."""
    images[:, [0, -1]] = images[:, :, [0, -1]] = 0
    return images


@pytest.fixture
def arrays() -> Arrays:
    """A valid file: two training views, one held out. The camera stands at (0, 0, 5) and looks along -z, y up."""
    rng = np.random.default_rng(0)
    c2w = np.diag([1.0, -1.0, -1.0, 1.0])
    c2w[2, 3] = 5.0
    return {
        "images_train": on_black(rng.integers(0, 256, (2, 6, 8, 3), dtype=np.uint8)),
        "c2ws_train": np.stack([c2w, c2w]),
        "images_val": on_black(rng.integers(0, 256, (1, 6, 8, 3), dtype=np.uint8)),
        "c2ws_val": c2w[None],
        "focal": np.array(10.0),
    }


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "Toy_8x6.npz"


def test_plain_file(arrays: Arrays, path: Path):
    np.savez(path, **arrays)
    scene = load_npz(path)
    assert scene.name == "toy" and scene.source == str(path) and scene.resolution == (8, 6)
    assert (scene.train.images.numpy() == arrays["images_train"]).all()
    assert (scene.val.images.numpy() == arrays["images_val"]).all()
    assert scene.background == (0.0, 0.0, 0.0) and not scene.bounds.unbounded
    torch.testing.assert_close(scene.train.cameras.K[1], torch.tensor([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]]))
    torch.testing.assert_close(scene.orbit.c2w, orbit_like(scene.train.cameras).c2w)
    assert torch.equal(scene.to_source, torch.eye(4))


def test_a_known_point_is_seen_at_its_pixel(arrays: Arrays, path: Path):
    np.savez(path, **arrays)
    # (1, 0.5, 0) is 1 right of, 0.5 above and 5 before the camera: u = 4 + 10 / 5, v = 3 - 10 * 0.5 / 5.
    scene = load_npz(path)
    ray = scene.train.cameras.rays(torch.tensor([0]), torch.tensor([1]), torch.tensor([5]))
    corner = scene.train.cameras.rays(torch.tensor([0]), torch.tensor([2]), torch.tensor([6]))
    # The point lies on the corner shared by pixels (1, 5) and (2, 6): halfway between their centres.
    direction = ray.directions / -ray.directions[:, 2:] + corner.directions / -corner.directions[:, 2:]
    torch.testing.assert_close(ray.origins[0] + 5 * direction[0] / 2, torch.tensor([1.0, 0.5, 0.0]))


@pytest.mark.parametrize("left_out", [None, "focal"], ids=["K and focal", "K alone"])
def test_K_near_far_and_box_come_from_the_file(left_out: str | None, arrays: Arrays, path: Path):
    arrays.pop(left_out, None)
    K = np.array([[11.0, 0, 3], [0, 12, 2], [0, 0, 1]])
    box = np.array([[-1.0, -2, -3], [1, 2, 3]])
    np.savez(path, **arrays, K=K, near=2.0, far=np.array([6.0]), aabb=box)
    scene = load_npz(path, "other")
    assert scene.name == "other"
    np.testing.assert_allclose(scene.val.cameras.K[0], K)
    np.testing.assert_allclose(scene.bounds.aabb, box)
    assert (scene.bounds.near, scene.bounds.far) == (2.0, 6.0)


def test_splits_of_own_files(arrays: Arrays, path: Path):
    """Test photos count apart from val, or instead of it; without both, some training photos are held out."""
    test = {"images_test": arrays["images_train"], "c2ws_test": arrays["c2ws_train"]}
    np.savez(path, **arrays, **test)
    scene = load_npz(path)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (2, 1, 2)
    train = {key: value for key, value in arrays.items() if "val" not in key}
    np.savez(path, **train, **test)
    assert (len(load_npz(path).val), load_npz(path).test) == (2, None)
    np.savez(path, **train)
    assert (len(load_npz(path).train), len(load_npz(path).val)) == (1, 1)


def test_float_images_become_bytes(arrays: Arrays, path: Path):
    exact = arrays["images_train"]
    np.savez(path, **{**arrays, "images_train": exact.astype(np.float32) / 255})
    assert (load_npz(path).train.images.numpy() == exact).all()


def test_round_trip(ball: Scene, path: Path):
    bounds = replace(ball.bounds, unbounded=True, near=0.5, far=9.0)
    to_source = torch.tensor([[2.0, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    scene = replace(ball, bounds=bounds, background=(1.0, 1.0, 1.0), to_source=to_source)
    save_npz(scene, path)
    back = load_npz(path)
    assert back.sha256() == scene.sha256()
    for name in ("train", "val"):
        assert torch.equal(getattr(back, name).cameras.c2w, getattr(scene, name).cameras.c2w)
        assert torch.equal(getattr(back, name).cameras.K, getattr(scene, name).cameras.K)
    assert torch.equal(back.orbit.c2w, scene.orbit.c2w)
    assert torch.equal(back.bounds.aabb, bounds.aabb)
    assert (back.bounds.unbounded, back.bounds.near, back.bounds.far) == (True, 0.5, 9.0)
    assert back.background == (1.0, 1.0, 1.0) and torch.equal(back.to_source, to_source)


def test_a_plain_scene_is_saved_in_the_plain_course_format(ball: Scene, path: Path):
    save_npz(ball, path)
    with np.load(path, allow_pickle=False) as file:
        course = {"images_train", "c2ws_train", "images_val", "c2ws_val", "c2ws_test", "focal", "K", "aabb"}
        assert set(file.files) == course
        assert file["focal"].shape == () and file["images_train"].dtype == np.uint8


def test_a_failed_save_leaves_the_old_file(ball: Scene, path: Path, monkeypatch: pytest.MonkeyPatch):
    path.write_bytes(b"old")

    def fail(file: object, **arrays: np.ndarray) -> None:
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(InputError, match="disk full"):
        save_npz(ball, path)
    assert path.read_bytes() == b"old" and os.listdir(path.parent) == [path.name]


def test_views_of_different_K_cannot_be_saved(ball: Scene, path: Path):
    K = ball.train.cameras.K.clone()
    K[1, 0, 0] += 1
    train = replace(ball.train, cameras=replace(ball.train.cameras, K=K))
    with pytest.raises(InputError, match="K: found views with different intrinsics"):
        save_npz(replace(ball, train=train), path)
    assert not path.exists()


def _set(**entries: object) -> Callable[[Arrays], dict]:
    """Entries replaced; None leaves one out."""
    return lambda arrays: {key: None if value is None else np.array(value) for key, value in entries.items()}


def _pose(edit: Callable[[np.ndarray], object]) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {"c2ws_train": np.stack([arrays["c2ws_train"][0], edit(arrays["c2ws_train"][1])])}


def _train(edit: Callable[[np.ndarray], object]) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {"images_train": edit(arrays["images_train"])}


def _held_out(edit: Callable[[np.ndarray], object]) -> Callable[[Arrays], Arrays]:
    return lambda arrays: {"images_val": edit(arrays["images_val"])}


BOX = [[0, 0, 0], [1, 1, 1]]
DAMAGE = {
    "images missing": (_set(images_train=None), "images_train: found no such key among [c2ws_train, c2ws_val"),
    "focal missing": (_set(focal=None), "focal: found no such key"),
    "images rank": (_train(lambda x: x[0]), "images_train: found shape (6, 8, 3)"),
    "images channels": (_train(lambda x: x[..., :2]), "images_train: found shape (2, 6, 8, 2)"),
    "images dtype": (_train(lambda x: x.astype(int)), "images_train: found dtype int64"),
    "floats to 255": (_held_out(lambda x: x * 1.0), "images_val: found floats from"),
    "nan in images": (_held_out(lambda x: x * np.nan), "images_val: found floats from nan"),
    "unequal sizes": (_held_out(lambda x: x[:, :4]), "images_val: found 8x4 with 3 channels"),
    "no training views": (_train(lambda x: x[:0]), "images_train: found 0 views"),
    "no held-out views": (_held_out(lambda x: x[:0]), "images_val: found 0 views"),
    "no orbit views": (_set(c2ws_test=np.zeros((0, 4, 4))), "c2ws_test: found 0 views"),
    "too few poses": (lambda a: {"c2ws_train": a["c2ws_val"]}, "images_train: found 2 images for 1 poses"),
    "pose shape": (_set(c2ws_train=np.zeros((2, 3, 4))), "c2ws_train: found shape (2, 3, 4)"),
    "pose dtype": (_set(c2ws_train=np.zeros((2, 4, 4)).astype(str)), "c2ws_train: found shape (2, 4, 4), <U"),
    "nan pose": (_pose(lambda p: p * np.nan), "c2ws_train[1]: found nan"),
    "scaled pose": (_pose(lambda p: p * [2, 2, 3, 1]), "c2ws_train[1]: found R^T R"),
    "mirrored pose": (_pose(lambda p: p * [-1, 1, 1, 1]), "c2ws_train[1]: found a mirror"),
    "transposed pose": (_pose(lambda p: p.T), "c2ws_train[1]: found bottom row"),
    "object array": (_set(focal=[{}]), "focal: found something unreadable (ValueError: Object arrays"),
    "focal sign": (_set(focal=-3.0), "focal: found -3, expected a positive number of pixels"),
    "focal nan": (_set(focal=np.nan), "focal: found nan"),
    "focal per view": (_set(focal=[1.0, 1.0]), "focal: found shape (2,)"),
    "focal text": (_set(focal="10"), "focal: found shape (), <U2"),
    "K shape": (_set(K=np.eye(4)), "K: found shape (4, 4)"),
    "K transposed": (_set(K=[[9.0, 0, 0], [0, 9, 0], [4, 3, 1]]), "K: found [[9.0"),
    "K with a number that rounding cannot hold": (
        _set(K=[[9.0, 0, 4], [0, 9, 3], [0, 0, 1.7e308]]),
        "K: found [[9.0, 0.0, 4.0], [0.0, 9.0, 3.0], [0.0, 0.0, 1.7e+308]]",
    ),
    "near beyond far": (_set(near=3.0, far=2.0), "far: found 2, expected more than near, 3"),
    "near negative": (_set(near=-1.0), "near: found -1"),
    "box flipped": (_set(aabb=[[1.0, 1, 1], [0, 2, 2]]), "aabb: found [[1.0"),
    "box shape": (_set(aabb=np.zeros(6)), "aabb: found shape (6,)"),
    "unbounded": (_set(aabb=BOX, unbounded=1), "unbounded: found int64"),
    "pose far off": (_pose(lambda x: x + 1e39 * np.eye(4, k=3)), "c2ws_train[1]: found a camera at 1e+39"),
    "focal beyond float": (
        _set(focal=1e39),
        "focal: found 1e+39, expected a focal length of 9.5e-07 to 8388608 pixels",
    ),
    "focal of no angle": (_set(focal=1e9), "focal: found 1e+09, expected a focal length"),
    "focal of nothing": (_set(focal=1e-300), "focal: found 1e-300, expected a focal length"),
    "K beyond float": (_set(K=np.diag([1e39, 9, 1])), "K[0][0]: found 1e+39, expected a focal length"),
    "K of no sensor": (_set(K=[[9, 0, 1e9], [0, 9, 3], [0, 0, 1]]), "K[0][2]: found 1e+09, expected at most"),
    "K skewed beyond float": (_set(K=[[9, 1e39, 4], [0, 9, 3], [0, 0, 1]]), "K[0][1]: found 1e+39"),
    "box beyond float": (
        _set(aabb=[[0, 0, 0], [1e39, 1, 1]]),
        "aabb: found a corner at 1e+39, expected coordinates of",
    ),
    "box of nothing": (_set(aabb=[[1e8, 0, 0], [1e8 + 1e-3, 1, 1]]), "aabb: found [[1000"),
    "far beyond float": (_set(far=1e39), "far: found 1e+39, expected a distance from 0 to 1e+12"),
    "similarity of zeros": (_set(to_source=np.zeros((4, 4))), "to_source: found a scale or a shift"),
    "similarity beyond float": (_set(to_source=np.diag([1e300] * 3 + [1])), "to_source: found a scale or a shift"),
    "sheared": (_set(to_source=np.eye(4) + np.eye(4, k=1) * [0, 1, 0, 0]), "to_source: found [[1.0, 1.0"),
    "mirrored": (_set(to_source=np.diag([1, 1, -1, 1])), "to_source: found [[1.0, 0.0"),
    "similarity transposed": (_set(to_source=np.eye(4) + 5 * np.eye(4, k=-3)), "to_source: found bottom row [5.0"),
    "colour of none": (_set(background=[0, 2, 1e39]), "background: found [0.0, 2.0"),
    "background": (_set(background=np.zeros(4)), "background: found shape (4,)"),
    "too many numbers": (_set(near=np.zeros(17)), "near: found shape (17,), expected at most 16 numbers"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_entries(damage: str, arrays: Arrays, path: Path, says: Callable):
    edit, words = DAMAGE[damage]
    np.savez(path, **{key: value for key, value in {**arrays, **edit(arrays)}.items() if value is not None})
    with pytest.raises(InputError) as caught:
        load_npz(path)
    says(caught.value, f"{path}: {words}", ", expected ")


def _corrupt(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[300:340] = bytes(40)  # inside the first entry, images_train
    path.write_bytes(data)


def _single_array(path: Path) -> None:
    with path.open("wb") as file:  # np.save would add .npy to a name
        np.save(file, np.zeros(3))


BROKEN = {
    "missing": (Path.unlink, "nothing there"),
    "folder": (lambda path: (path.unlink(), path.mkdir()), "a folder"),
    "empty": (lambda path: path.write_bytes(b""), "no zip archive"),
    "text": (lambda path: path.write_text("hello"), "no zip archive"),
    "single array": (_single_array, "no zip archive"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-200]), "something unreadable (BadZipFile"),
    "corrupt": (_corrupt, "images_train: found something unreadable (BadZipFile: Bad CRC"),
}


@pytest.mark.parametrize("damage", BROKEN)
def test_broken_files(damage: str, arrays: Arrays, path: Path, says: Callable):
    np.savez(path, **arrays)
    spoil, words = BROKEN[damage]
    spoil(path)
    with pytest.raises(InputError) as caught:
        load_npz(path)
    says(caught.value, path, words)


class Payload:
    """Writes a file when unpickled."""

    def __init__(self, target: Path):
        self.target = target

    def __reduce__(self):
        return (open, (str(self.target), "w"))


def test_nothing_in_a_file_is_executed(arrays: Arrays, path: Path, tmp_path: Path):
    target = tmp_path / "executed"
    np.savez(path, **{**arrays, "focal": np.array([Payload(target)], dtype=object)})
    with pytest.raises(InputError, match="Object arrays cannot be loaded"):
        load_npz(path)
    assert not target.exists()


@pytest.mark.parametrize("unit", [1e-11, 1e-6, 1e-3, 1e6, 1e11])
def test_a_scene_in_any_unit_gets_the_same_box(unit: float, ball: Scene, path: Path):
    save_npz(ball, path)
    with np.load(path) as file:
        arrays = {key: file[key].astype(np.float64) if key.startswith("c2ws") else file[key] for key in file}
    del arrays["aabb"]
    np.savez(path, **arrays)
    expected = load_npz(path).bounds.aabb
    for key in ("c2ws_train", "c2ws_val", "c2ws_test"):
        arrays[key][:, :3, 3] *= unit
    np.savez(path, **arrays)
    torch.testing.assert_close(load_npz(path).bounds.aabb / unit, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("unit", "words"),
    [
        (1e-13, "e-13 from what they look at, expected a distance of 1e-12 to 1e+12; take another unit"),
        (1e-300, "from what they look at, expected a distance"),
    ],
)
def test_cameras_that_single_precision_cannot_tell_apart(unit: float, words: str, ball: Scene, path: Path):
    save_npz(ball, path)
    with np.load(path) as file:
        arrays = dict(file)
    for key in ("c2ws_train", "c2ws_val", "c2ws_test"):
        arrays[key] = arrays[key].astype(np.float64)
        arrays[key][:, :3, 3] = arrays[key][:, :3, 3] * unit
    np.savez(path, **arrays)
    with pytest.raises(InputError) as caught:
        load_npz(path)
    assert words in str(caught.value)


@pytest.mark.parametrize("shift", [0, 1e6])
def test_cameras_on_one_spot_are_a_panorama_wherever_that_is(shift: float, ball: Scene, path: Path):
    save_npz(ball, path)
    with np.load(path) as file:
        arrays = dict(file)
    for key in ("c2ws_train", "c2ws_val", "c2ws_test"):
        arrays[key] = arrays[key].astype(np.float64)
        arrays[key][:, :3, 3] = shift
    np.savez(path, **arrays)
    assert load_npz(path).bounds.aabb.isfinite().all()
