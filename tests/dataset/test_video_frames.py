import logging
from collections.abc import Iterator
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest

from benchmarks.synthetic.video import blur_images, write_video
from nerf_lightning.dataset.sfm import video_frames as module
from nerf_lightning.dataset.sfm.video_frames import MAX_FRAMES, extract_frames, select_frames, write_frames
from nerf_lightning.errors import InputError

PAUSE = 24
SHIFTS = np.concatenate([4 * np.arange(31), np.full(PAUSE, 120), 120 + 4 * np.arange(1, 36)])
"""Camera position in pixels by frame, with a pause."""


def texture(height: int, width: int) -> np.ndarray:
    """Texture with detail at all scales."""
    rng, out = np.random.default_rng(0), np.zeros((height, width, 3))
    for sigma in (0.7, 2.0, 6.0):
        layer = cv2.GaussianBlur(rng.standard_normal((height, width, 3)), (0, 0), sigma)
        out += layer / layer.std()
    return (128 + 30 * out).clip(0, 255).astype(np.uint8)


def pan(shifts: np.ndarray) -> Iterator[np.ndarray]:
    """Frames of a camera moving along a wall; every third one, from the second, is brighter."""
    wall, rng = texture(120, 160 + int(max(shifts))), np.random.default_rng(1)
    for index, shift in enumerate(shifts):
        picture = wall[:, shift : shift + 160] * (1.0 if index % 3 == 1 else 0.75)
        yield (picture + rng.standard_normal(picture.shape)).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every third frame is blurred, weakly or strongly, and brighter; read only."""
    file = tmp_path_factory.mktemp("video") / "wall.mp4"
    write_video(file, blur_images(pan(SHIFTS), seed=0))
    return file


def test_write_frames_takes_sharp_evenly_spread_frames(video: Path, tmp_path: Path):
    write_frames(video, tmp_path, 22)
    photos = sorted(tmp_path.iterdir())
    indices = [int(photo.stem) for photo in photos]
    assert indices == sorted(indices) and len(indices) == 22
    assert not [index for index in indices if index % 3 == 1]
    assert sum(31 <= index < 31 + PAUSE for index in indices) <= 2
    assert max(np.diff(SHIFTS[indices])) <= 4 * 5
    first, pictures = imageio.imread(photos[0]).astype(int), list(pan(SHIFTS))
    assert np.argmin([np.abs(first - picture).mean() for picture in pictures]) == indices[0]


def test_select_frames_count_follows_motion(video: Path):
    moving = 1 + np.count_nonzero(np.diff(SHIFTS))
    assert abs(len(select_frames(*module.measure_frames(video))) - moving // 3) <= 2
    for motion, count in ((np.full(5000, 0.01), MAX_FRAMES), (np.zeros(900), 3), (np.full(50, 0.002), 10)):
        assert len(select_frames(motion, np.zeros_like(motion))) == count


def test_select_frames_of_fast_stretch_takes_sharp_ones():
    motion, sharpness = np.concatenate([np.full(60, 0.001), np.full(12, 0.1)]), np.zeros(72)
    sharpness[1::3] = -0.2
    chosen = select_frames(motion, sharpness, 12)
    assert len(chosen) >= 5 and not [index for index in chosen if index % 3 == 1]
    assert select_frames(np.zeros(9), np.eye(9)[4], 3)[1] == 4


def test_write_frames_of_rotated_video_are_upright(tmp_path: Path):
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:32, 48:], picture[32:, :48] = (255, 0, 0), (0, 0, 255)
    write_video(tmp_path / "a.mp4", [picture] * 3, 1)
    upright = imageio.imread(next(extract_frames(tmp_path / "a.mp4").glob("*.jpg")))
    assert np.abs(upright.astype(int) - np.rot90(picture, 1)).mean() < 5


def test_extract_frames_twice_decodes_once(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    video = tmp_path / "wall.mp4"
    write_video(video, pan(SHIFTS[:12]))
    folder = extract_frames(video)
    assert len(list(folder.glob("*.jpg"))) == 4
    next(folder.glob("*.jpg")).unlink()
    assert len(list(extract_frames(video).glob("*.jpg"))) == 3, "deleted frames are not restored"
    write_video(video, pan(SHIFTS[:15]))
    with caplog.at_level(logging.INFO):
        assert len(list(extract_frames(video).glob("*.jpg"))) == 5
    assert "the source files changed" in caplog.text


def truncate(file: Path) -> None:
    write_video(file, pan(SHIFTS[:9]))
    file.write_bytes(file.read_bytes()[:4000])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda file: None, "no such file"),
        (truncate, "cannot be decoded"),
        (lambda file: write_video(file, pan(SHIFTS[:1])), "found 1 frame, expected at least 3"),
    ],
)
def test_extract_frames_of_broken_video_raises(make, message: str, tmp_path: Path):
    video = tmp_path / "broken.mp4"
    make(video)
    with pytest.raises(InputError, match=message) as raised:
        extract_frames(video)
    assert str(video) in str(raised.value) and "\n" not in str(raised.value)
    assert [path for path in tmp_path.iterdir() if path != video] == []
