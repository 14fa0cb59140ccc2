"""Frames become videos, and interrupted ones continue."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from nerf_lightning.errors import InputError
from nerf_lightning.render.video import write_video

COLORS = [(255, 0, 0), (0, 255, 0), (0, 0, 255)]


def plain(index: int, height: int = 9, width: int = 15) -> np.ndarray:
    return np.full((height, width, 3), COLORS[index], np.uint8)


@pytest.mark.parametrize("suffix", [".gif", ".webp", ".mp4"])
def test_write_video_frames_are_in_order_and_at_their_size(suffix: str, tmp_path: Path):
    output = tmp_path / f"film{suffix}"
    assert write_video({}, plain, 3, output, fps=10) == 0
    film = imageio.imread(output, plugin="pyav" if suffix == ".mp4" else "pillow", index=...)
    assert film.shape == (3, *((10, 16) if suffix == ".mp4" else (9, 15)), 3)  # one more row and column, no resize
    for shown, color in zip(film, COLORS, strict=True):
        assert np.abs(shown.astype(int) - color).max() <= (0 if suffix == ".gif" else 12)
    assert [path.name for path in tmp_path.iterdir()] == [output.name]


def test_write_video_webp_keeps_transparency(tmp_path: Path):
    def half(index: int) -> np.ndarray:
        return np.concatenate([plain(index), np.full((9, 15, 1), 100, np.uint8)], axis=2)

    write_video({}, half, 3, tmp_path / "film.webp", fps=10)
    film = imageio.imread(tmp_path / "film.webp", plugin="pillow", mode="RGBA", index=...)
    assert film.shape == (3, 9, 15, 4) and (np.abs(film[..., 3].astype(int) - 100) < 5).all()


def test_write_video_interrupted_resumes_and_other_manifest_restarts(tmp_path: Path):
    output, drawn = tmp_path / "film.gif", []

    def failing(index: int) -> np.ndarray:
        drawn.append(index)
        if index == 2 and len(drawn) == 3:
            raise KeyboardInterrupt
        return plain(index)

    with pytest.raises(ZeroDivisionError):
        write_video({"what": 1}, lambda index: plain(1 // index), 3, output, fps=10)
    assert not list(tmp_path.iterdir()), "of a film without a single frame nothing is left"
    with pytest.raises(KeyboardInterrupt):
        write_video({"what": 1}, failing, 3, output, fps=10)
    assert not output.exists()
    assert write_video({"what": 1}, failing, 3, output, fps=10) == 2
    assert drawn == [0, 1, 2, 2]
    with pytest.raises(ZeroDivisionError):
        write_video({"what": 1}, lambda index: plain(index // (1 - index)), 3, output, fps=10)
    assert write_video({"what": 2}, plain, 3, output, fps=10) == 0, "frames of something else do not count"


def test_write_video_folder_keeps_its_frames(tmp_path: Path):
    assert write_video({"what": 1}, plain, 3, tmp_path / "frames", fps=10) == 0
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert names == ["00000.png", "00001.png", "00002.png", "frames.json"]
    assert write_video({"what": 1}, plain, 3, tmp_path / "frames", fps=10) == 3
    with pytest.raises(InputError, match="holds other files"):
        write_video({"what": 2}, plain, 3, tmp_path / "frames", fps=10)
