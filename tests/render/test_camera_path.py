"""Which views a video shows, against circles whose geometry is known."""

import json
import math
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras import Cameras, make_circle_poses, resample_path
from nerf_lightning.errors import InputError
from nerf_lightning.render.camera_path import PHOTO_PATHS, build_path
from nerf_lightning.render.path_file import read_path
from nerf_lightning.synthetic.bricks import bricks

UP = torch.tensor([0.0, 0.6, 0.8])
CENTER = torch.tensor([1.0, -2.0, 0.5])
K = torch.tensor([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]])


def circle(frames: int = 12, elevation: float = 0.5) -> Cameras:
    return Cameras.pinhole(K.repeat(frames, 1, 1), make_circle_poses(CENTER, UP, 3.0, elevation, frames), 16, 12)


def test_resample_path_more_frames_interpolate():
    path, fine = circle(12), resample_path(circle(12), 24, closed=True)
    torch.testing.assert_close(fine.c2w[::2], path.c2w, atol=1e-5, rtol=0)
    torch.testing.assert_close(fine.K, K.repeat(24, 1, 1))
    expected = circle(24).c2w
    torch.testing.assert_close(fine.c2w[:, :3, :3], expected[:, :3, :3], atol=0.02, rtol=0)  # the last one, too
    height = 3 * (1 - math.cos(math.pi / 12))  # of a chord
    assert (fine.centers - expected[:, :3, 3]).norm(dim=1).max() < height + 1e-4


def test_resample_path_open_keeps_ends():
    path = circle(4)
    fine = resample_path(path, 9, closed=False)
    torch.testing.assert_close(fine.c2w[[0, -1]], path.c2w[[0, -1]], atol=1e-6, rtol=0)
    assert len(resample_path(path[:1], 5, closed=True)) == 1
    assert torch.equal(resample_path(circle(12), 4, closed=True).c2w, circle(12).c2w[torch.tensor([1, 4, 7, 10])])


@pytest.mark.parametrize(
    ("path", "frames", "count"),
    [("orbit", None, 6), ("orbit", 9, 9), ("spiral", None, 120), ("test", None, 2), ("train", 3, 3)],
)
def test_build_path_named_paths_have_frames(path: str, frames: int | None, count: int):
    scene = bricks(size=16, train_views=4, val_views=2, orbit_views=6)
    route = build_path(path, frames, scene.orbit, scene if path in PHOTO_PATHS else None, torch.eye(4))
    assert len(route.cameras) == len(route.views) == count
    if path == "train":
        assert route.views == [0, 2, 3] or len(set(route.views)) == 3
        assert route.photos is not None
        assert torch.equal(route.photos.images, scene.train.images[torch.tensor(route.views)])
    else:
        assert (route.photos is None) == (path != "test")


def test_read_path_converts_frame(tmp_path: Path, capsys: pytest.CaptureFixture):
    """The file's frame is that of the run, turned, three times as large and shifted."""
    path, to_source = circle(5), torch.eye(4)
    to_source[:3, :3] = 3 * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    to_source[:3, 3] = torch.tensor([10.0, -20, 30])
    in_file = to_source @ path.c2w
    in_file[:, :3, :3] /= 3
    fov = math.degrees(2 * math.atan(6 / 50))
    flip = torch.diag(torch.tensor([1.0, -1, -1, 1]))
    theirs = [{"camera_to_world": (pose @ flip).flatten().tolist(), "fov": fov} for pose in in_file]
    cycled = in_file[:, [1, 2, 0]].double()  # instant-ngp: (x, y, z) becomes 0.33 (y, z, x) + 0.5
    R = Rotation.from_matrix(cycled[:, :, :3].numpy()).as_quat()
    ngp = [
        {"R": turn.tolist(), "T": (0.33 * place + 0.5).tolist(), "fov": fov}
        for turn, place in zip(R, cycled[:, :, 3], strict=True)
    ]
    own = {"width": 16, "height": 12, "K": K.tolist(), "c2w": in_file.tolist()}
    for name, content in {
        "nerfstudio": {"render_width": 16, "render_height": 12, "camera_path": theirs},
        "ngp": {"path": ngp, "time": 1.0},
        "own": own,
    }.items():
        file = tmp_path / f"{name}.json"
        file.write_text(json.dumps(content))
        frame = "file" if name == "own" else "auto"
        read = build_path(str(file), None, path, None, to_source, frame).cameras
        torch.testing.assert_close(read.c2w, path.c2w, atol=1e-4, rtol=0)
        torch.testing.assert_close(read.K, path.K, atol=1e-3, rtol=0)
        assert (read.width, read.height) == (16, 12)
        out = capsys.readouterr().out
        assert "in the world frame of the photos' own file (--path-frame run takes the other)" in out
        read = build_path(str(file), None, path, None, to_source, "run").cameras
        torch.testing.assert_close(read.c2w, in_file, atol=1e-4, rtol=0)
        assert "in the run's frame" in capsys.readouterr().out
    torch.testing.assert_close(build_path(str(file), None, path, None, to_source).cameras.c2w, in_file)


THEIRS = (
    '{"render_width": %s, "render_height": 4, "camera_path": [{"camera_to_world": '
    '[1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1], "fov": %s}]}'
)
PATH = '{"width": 4, "height": 4, "K": [[%s,0,2],[0,1,2],[0,0,1]], "c2w": %s}'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"width": 4}', "KeyError: 'height'"),
        (PATH % ("NaN", "[[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]]"), "nan"),
        (PATH % (0, "[[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]]"), "K: found"),
        (THEIRS % (4, 0), "division by zero"),
        (PATH % (1, "[[[-1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]]"), "mirror"),
        ('{"path": [{"R": [0,0,0,0], "T": [0,0,0], "fov": 50}]}', "zero norm"),
    ],
)
def test_read_path_damaged_file_raises(content: str, message: str, tmp_path: Path):
    (tmp_path / "path.json").write_text(content)
    with pytest.raises(InputError, match=message):
        read_path(tmp_path / "path.json", circle(), torch.eye(4))
