import json
import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from nerf_lightning.cameras import transform_points
from nerf_lightning.dataset import Scene, load_transforms
from nerf_lightning.dataset.photo_loading import PhotoLoadOptions

W, H = 160, 120
INTRINSICS = {"fl_x": 140.0, "fl_y": 150.0, "cx": 83.0, "cy": 56.0, "w": W, "h": H}
LENS = {"k1": -0.25, "k2": 0.06, "p1": 0.004, "p2": -0.006, "k3": -0.01}
POINT = np.array([0.9, -0.4, 0.7])


def opengl_pose(angle: float) -> np.ndarray:
    """A camera 5 units from the world's y axis, looking at the origin, y up; OpenGL axes (viewing along -z)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, 5 * s], [0, 1, 0, 0.3], [-s, 0, c, 5 * c], [0, 0, 0, 1]])


def project_point(pose: np.ndarray, intrinsics: dict, point: np.ndarray) -> np.ndarray:
    """Projects a world point, in OpenCV's indices (pixel centers are integers)."""
    local = pose[:3, :3].T @ (point - pose[:3, 3])
    fx, fy, cx, cy = (intrinsics[key] for key in ("fl_x", "fl_y", "cx", "cy"))
    K = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    distortion = np.array([intrinsics.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
    # y and z flip from OpenGL's camera axes to OpenCV's.
    pixel, _ = cv2.projectPoints((local * [1, -1, -1]).reshape(1, 1, 3), np.zeros(3), np.zeros(3), K, distortion)
    return pixel.reshape(2)


def dot(at: np.ndarray) -> np.ndarray:
    """A soft bright dot on black, centered on an OpenCV index."""
    x, y = np.meshgrid(np.arange(W), np.arange(H))
    value = np.rint(250 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 2.5**2))).astype(np.uint8)
    return np.repeat(value[..., None], 3, axis=2)


def write(folder: Path, extra: dict, per_frame: Callable[[int], dict] = lambda i: {}) -> Path:
    """A capture whose photos show POINT as a dot; `per_frame` adds intrinsics to one frame."""
    (folder / "images").mkdir(parents=True)
    entries = []
    for i in reversed(range(12)):  # out of order: loaders sort by file_path
        pose, own = opengl_pose(0.5 * i), per_frame(i)
        cv2.imwrite(str(folder / f"images/{i:04d}.png"), dot(project_point(pose, {**extra, **own}, POINT)))
        entries.append({"file_path": f"images/{i:04d}.png", "transform_matrix": pose.tolist(), **own})
    (folder / "transforms.json").write_text(json.dumps({**extra, "frames": entries}))
    return folder


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write(tmp_path / "Garden", INTRINSICS)


def dot_error(scene: Scene) -> float:
    """Largest distance in pixels of POINT from the rays through its dots."""
    point = transform_points(torch.linalg.inv(scene.to_source), torch.from_numpy(POINT).float())
    worst = 0.0
    for views in (scene.train, scene.val):
        weights = views.images[..., 1].double()
        u, v = torch.arange(views.cameras.width) + 0.5, torch.arange(views.cameras.height) + 0.5
        total = weights.sum((1, 2))
        centroid = torch.stack([(weights.sum(1) * u).sum(-1) / total, (weights.sum(2) * v).sum(-1) / total], dim=-1)
        pixel = torch.cat([views.cameras.project(point[None], view)[0] for view in range(len(views))])
        worst = max(worst, float((pixel - centroid).norm(dim=-1).max()))
    return worst


def test_load_transforms_plain_capture_returns_its_views(capture: Path):
    scene = load_transforms(capture)
    assert scene.name == "garden" and scene.resolution == (W, H)
    assert (len(scene.train), len(scene.val), len(scene.orbit)) == (10, 2, 60)
    first = cv2.imread(str(capture / "images/0000.png"))
    assert (scene.val.images[0].numpy() == first).all()  # sorted; frames 0 and 8 are held out
    expected = torch.tensor([[140.0, 0, 83], [0, 150, 56], [0, 0, 1]])
    torch.testing.assert_close(scene.train.cameras.K, expected.repeat(10, 1, 1))
    assert not scene.bounds.unbounded and scene.background == (0.0, 0.0, 0.0), "the subject is on plain black"


def test_load_transforms_distortion_is_followed(tmp_path: Path):
    """One lens of all frames, and one for each frame."""
    assert dot_error(load_transforms(write(tmp_path / "one", {**INTRINSICS, **LENS}))) < 0.05

    def own(i: int) -> dict:
        return {"fl_x": 130.0 + i, "cx": 80.0 + i, "k1": 0.02 * i}

    scene = load_transforms(write(tmp_path / "capture", INTRINSICS, per_frame=own))
    assert len(set(scene.train.cameras.K[:, 0, 0].tolist())) == 10
    assert dot_error(scene) < 0.05


def change(capture: Path, edit: Callable[[dict], object]) -> None:
    path = capture / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"].sort(key=lambda frame: frame["file_path"])
    edit(content)
    path.write_text(json.dumps(content))


def test_load_transforms_mask_path_is_read(capture: Path, caplog: pytest.LogCaptureFixture):
    mask = np.full((H, W), 255, np.uint8)
    mask[:50] = 0
    cv2.imwrite(str(capture / "mask.png"), mask)
    change(capture, lambda c: c["frames"][1].update(mask_path="mask.png", depth_file_path="depth.png"))
    with caplog.at_level(logging.INFO):
        scene = load_transforms(capture, options=PhotoLoadOptions(masked="ignore"))
    assert "ignoring unknown keys: depth_file_path" in caplog.text
    assert torch.equal(scene.train.view_mask(0), torch.from_numpy(mask > 0)) and scene.train.view_mask(1).all()


def test_load_transforms_missing_photos_are_ignored_with_a_warning(capture: Path, caplog: pytest.LogCaptureFixture):
    for i in (3, 4, 7):
        (capture / f"images/{i:04d}.png").unlink()
    with caplog.at_level(logging.WARNING):
        scene = load_transforms(capture)
    assert (len(scene.train), len(scene.val)) == (7, 2) and "ignoring 3 of 12 photos without a file" in caplog.text
    assert dot_error(scene) < 0.02, "poses stay with their photos"


def test_load_transforms_applied_transform_and_scale_are_undone(capture: Path, caplog: pytest.LogCaptureFixture):
    """`applied_scale`, after `applied_transform`: exports have the capture's unit. Scales of rotations are divided out."""
    before = load_transforms(capture)
    turn = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 2]])
    whole = np.concatenate([turn, [[0, 0, 0, 1]]])

    def apply(content: dict) -> None:
        content.update(applied_transform=turn.tolist(), applied_scale=0.1)
        for frame in content["frames"]:
            matrix = whole @ np.array(frame["transform_matrix"])
            matrix[:3, 3] *= 0.1
            matrix[:3, :3] *= 0.33
            frame["transform_matrix"] = matrix.tolist()

    change(capture, apply)
    with caplog.at_level(logging.WARNING):
        after = load_transforms(capture)
    assert "12 of 12 rotations have a uniform scale, such as 0.33: divided out" in caplog.text
    torch.testing.assert_close(after.to_source, before.to_source, atol=1e-5, rtol=0)
    torch.testing.assert_close(after.train.cameras.c2w, before.train.cameras.c2w, atol=1e-5, rtol=0)


def test_load_transforms_reduced_photos_keep_their_angle(capture: Path):
    before, factor = load_transforms(capture), 4
    for file in (capture / "images").iterdir():
        image = cv2.imread(str(file))
        cv2.imwrite(str(file), cv2.resize(image, (W // factor, H // factor), interpolation=cv2.INTER_AREA))
    after = load_transforms(capture)
    assert after.resolution == (W // factor, H // factor)
    expected = before.train.cameras.K[0] / torch.tensor([[factor], [factor], [1.0]])
    torch.testing.assert_close(after.train.cameras.K[0], expected)
    assert dot_error(after) < 0.1


def test_load_transforms_test_filenames_make_a_test_split(capture: Path):
    names = [f"./images/{i:04d}.png" for i in range(12)]
    change(capture, lambda c: c.update(train_filenames=names[4:], val_filenames=names[:1], test_filenames=names[1:4]))
    scene = load_transforms(capture)
    assert (len(scene.train), len(scene.val), len(scene.test)) == (8, 1, 3)
    assert scene.test.names == ("images/0001.png", "images/0002.png", "images/0003.png")
    assert (scene.test.images[1].numpy() == cv2.imread(str(capture / "images/0002.png"))).all()
