from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.cameras import make_orbit_path
from nerf_lightning.dataset import Scene, load_npz, save_npz
from nerf_lightning.dataset.region import find_region
from nerf_lightning.errors import InputError

Arrays = dict[str, np.ndarray]


def on_black(images: np.ndarray) -> np.ndarray:
    """Images with a black border."""
    images[:, [0, -1]] = images[:, :, [0, -1]] = 0
    return images


@pytest.fixture
def arrays() -> Arrays:
    """A valid file: two training views, one held out. The camera at (0, 0, 5) looks along -z, y up."""
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


def test_load_npz_plain_file_returns_its_arrays(arrays: Arrays, path: Path):
    np.savez(path, **{**arrays, "images_train": arrays["images_train"].astype(np.float32) / 255})
    scene = load_npz(path)
    assert scene.name == "toy" and scene.source == str(path) and scene.resolution == (8, 6)
    assert (scene.train.images.numpy() == arrays["images_train"]).all()
    assert (scene.val.images.numpy() == arrays["images_val"]).all()
    assert scene.background == (0.0, 0.0, 0.0) and not scene.bounds.unbounded
    torch.testing.assert_close(scene.train.cameras.K[1], torch.tensor([[10.0, 0, 4], [0, 10, 3], [0, 0, 1]]))
    cameras = scene.train.cameras
    region = find_region(cameras.c2w)
    torch.testing.assert_close(scene.orbit.c2w, make_orbit_path(cameras, region.layout, region.center).c2w)
    assert torch.equal(scene.to_source, torch.eye(4))


def test_load_npz_optional_keys_are_read(arrays: Arrays, path: Path):
    K = np.array([[11.0, 0, 3], [0, 12, 2], [0, 0, 1]])
    box = np.array([[-1.0, -2, -3], [1, 2, 3]])
    np.savez(path, **arrays, K=K, near=2.0, far=np.array([6.0]), aabb=box)
    scene = load_npz(path)
    np.testing.assert_allclose(scene.val.cameras.K[0], K)
    np.testing.assert_allclose(scene.bounds.aabb, box)
    assert (scene.bounds.near, scene.bounds.far) == (2.0, 6.0)


def test_load_npz_splits_follow_the_keys(arrays: Arrays, path: Path):
    """Test photos are separate from val, or held out instead of it; without both, some training photos are held out."""
    test = {"images_test": arrays["images_train"], "c2ws_test": arrays["c2ws_train"]}
    np.savez(path, **arrays, **test)
    scene = load_npz(path)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (2, 1, 2)
    train = {key: value for key, value in arrays.items() if "val" not in key}
    np.savez(path, **train, **test)
    assert (len(load_npz(path).val), load_npz(path).test) == (2, None)
    np.savez(path, **train)
    assert (len(load_npz(path).train), len(load_npz(path).val)) == (1, 1)


def test_save_npz_then_load_returns_the_same_scene(ball: Scene, path: Path):
    bounds = replace(ball.bounds, unbounded=True, near=0.5, far=9.0, core=ball.bounds.aabb / 4)
    to_source = torch.tensor([[2.0, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    scene = replace(ball, bounds=bounds, background=(1.0, 1.0, 1.0), to_source=to_source)
    save_npz(scene, path)
    back = load_npz(path)
    assert back.sha256() == scene.sha256()
    for name in ("train", "val"):
        assert torch.equal(getattr(back, name).cameras.c2w, getattr(scene, name).cameras.c2w)
        assert torch.equal(getattr(back, name).cameras.K, getattr(scene, name).cameras.K)
    assert torch.equal(back.orbit.c2w, scene.orbit.c2w)
    assert torch.equal(back.bounds.aabb, bounds.aabb) and torch.equal(back.bounds.core, bounds.core)
    assert (back.bounds.unbounded, back.bounds.near, back.bounds.far) == (True, 0.5, 9.0)
    assert back.background == (1.0, 1.0, 1.0) and torch.equal(back.to_source, to_source)


def test_save_npz_different_K_raises(ball: Scene, path: Path):
    K = ball.train.cameras.K.clone()
    K[1, 0, 0] += 1
    train = replace(ball.train, cameras=replace(ball.train.cameras, K=K))
    with pytest.raises(InputError, match="K: found views with different intrinsics"):
        save_npz(replace(ball, train=train), path)
    assert not path.exists()
