from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from nerf_lightning.dataset import Reading, Views, open_scene
from nerf_lightning.errors import InputError
from tests.helpers.colmap_files import write_scene


@pytest.fixture
def formats(ball_views_of: Callable[..., Views], tmp_path: Path) -> dict[str, Path]:
    return {
        format: write_scene(format, tmp_path / format, ball_views_of(4)) for format in ("npz", "blender", "transforms")
    }


def test_open_scene_json_file_is_opened_itself(formats: dict[str, Path]):
    folder = open_scene(str(formats["transforms"]))
    file = open_scene(str((formats["transforms"] / "transforms.json").rename(formats["transforms"] / "Other.json")))
    assert (folder.name, file.name) == ("transforms", "other") and file.sha256() == folder.sha256()


@pytest.mark.parametrize("format", ["npz", "blender", "transforms"])
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
    "empty folder": (lambda folder: (folder / "empty", (folder / "empty").mkdir())[0], "found an empty folder"),
    "other folder": (lambda folder: folder, "found a folder with blender, npz, transforms"),
    "other file": (lambda folder: (folder / "a.txt", (folder / "a.txt").write_text(""))[0], "found a .txt file"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_open_scene_unknown_path_raises(kind: str, formats: dict[str, Path], tmp_path: Path):
    make, words = WRONG[kind]
    path = make(tmp_path)
    with pytest.raises(InputError, match=words) as caught:
        open_scene(str(path))
    line = str(caught.value)
    assert str(path) in line and ", expected " in line and "\n" not in line
