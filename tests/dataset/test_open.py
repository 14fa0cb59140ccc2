import json
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.dataset import Reading, Scene, Views, open_scene, save_npz
from nerf_lightning.errors import InputError


def write_frames(folder: Path, views: Views, prefix: str) -> list[dict]:
    (folder / prefix).mkdir(parents=True)
    frames = []
    for i, (image, c2w) in enumerate(zip(views.images.numpy(), views.cameras.c2w, strict=True)):
        imageio.imwrite(folder / prefix / f"{i:03d}.png", image)
        opengl = c2w * torch.tensor([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"{prefix}/{i:03d}", "transform_matrix": opengl.tolist()})
    return frames


@pytest.fixture
def formats(ball: Scene, tmp_path: Path) -> dict[str, Path]:
    """The ball scene in every format that can be opened."""
    focal, width = float(ball.train.cameras.K[0, 0, 0]), ball.train.cameras.width
    save_npz(ball, tmp_path / "Ball_48x40.npz")
    angle = 2 * float(np.arctan(0.5 * width / focal))
    for split in ("train", "val"):
        content = {"camera_angle_x": angle, "frames": write_frames(tmp_path / "Blender", getattr(ball, split), split)}
        (tmp_path / f"Blender/transforms_{split}.json").write_text(json.dumps(content))
    frames = write_frames(tmp_path / "Studio", ball.train, "train") + write_frames(tmp_path / "Studio", ball.val, "val")
    content = {"fl_x": focal, "frames": frames, "val_filenames": [f["file_path"] for f in frames[len(ball.train) :]]}
    for name in ("transforms", "Other"):
        (tmp_path / f"Studio/{name}.json").write_text(json.dumps(content))
    return {
        "npz": tmp_path / "Ball_48x40.npz",
        "blender": tmp_path / "Blender",
        "studio": tmp_path / "Studio",
        "json": tmp_path / "Studio/Other.json",
    }


@pytest.mark.parametrize(
    ("format", "name"), [("npz", "ball"), ("blender", "blender"), ("studio", "studio"), ("json", "other")]
)
def test_open_scene_formats_give_the_same_scene(format: str, name: str, formats: dict[str, Path], ball: Scene):
    scene = open_scene(str(formats[format]))
    assert scene.name == name and scene.source == str(formats[format])
    assert scene.sha256() == ball.sha256()
    # In the frame of the file all formats agree on every ray.
    mine, theirs = scene.val.cameras.view_rays(1), ball.val.cameras.view_rays(1)
    to_source = scene.to_source.double()
    origins = mine.origins.double() @ to_source[:3, :3].T + to_source[:3, 3]
    torch.testing.assert_close(origins.float(), theirs.origins, atol=1e-5, rtol=0)
    torch.testing.assert_close(mine.directions, theirs.directions, atol=1e-5, rtol=0)


@pytest.mark.parametrize("format", ["npz", "blender", "studio"])
def test_open_scene_options_reach_every_format(format: str, formats: dict[str, Path]):
    scene = open_scene(str(formats[format]), reading=Reading(resize=24), name="mine", near=0.5, far=2.0)
    assert scene.name == "mine" and scene.resolution == (24, 20)
    assert scene.train.images.shape[1:3] == scene.val.images.shape[1:3] == (20, 24)
    assert (scene.orbit.width, scene.orbit.height) == (24, 20)
    K = torch.tensor([[30.0, 0, 12], [0, 30, 10], [0, 0, 1]])
    torch.testing.assert_close(scene.val.cameras.K[0], K)
    torch.testing.assert_close(scene.orbit.K[0], K)
    assert (scene.bounds.near, scene.bounds.far) == (0.5, 2.0)


WRONG = {
    "nothing": (lambda folder: folder / "absent", "found nothing there"),
    "missing npz": (lambda folder: folder / "absent.npz", "found nothing there"),
    "missing json": (lambda folder: folder / "absent.json", "found nothing there"),
    "empty folder": (lambda folder: (folder / "empty", (folder / "empty").mkdir())[0], "found an empty folder"),
    "other folder": (lambda folder: folder, "found a folder with Ball_48x40.npz, Blender, Studio"),
    "other file": (lambda folder: (folder / "a.txt", (folder / "a.txt").write_text(""))[0], "found a .txt file"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_open_scene_unknown_path_raises(kind: str, formats: dict[str, Path], tmp_path: Path, says: Callable):
    make, words = WRONG[kind]
    path = make(tmp_path)
    with pytest.raises(InputError) as caught:
        open_scene(str(path))
    says(caught.value, path, words, ", expected ")


@pytest.mark.parametrize(
    ("near", "far", "words"),
    [
        (3.0, 2.0, "far: found 2"),
        (2.0, 2.0, "far: found 2"),
        (-1.0, None, "near: found -1"),
        (float("nan"), None, "near: found nan"),
    ],
)
def test_open_scene_impossible_distances_raise(
    near: float, far: float | None, words: str, formats: dict[str, Path], says: Callable
):
    with pytest.raises(InputError) as caught:
        open_scene(str(formats["npz"]), near=near, far=far)
    says(caught.value, formats["npz"], words)
