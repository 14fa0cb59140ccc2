import weakref
from collections.abc import Iterator
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.drawing.depth import colorize_depth
from nerf_lightning.drawing.panels import (
    SMALLEST_SIDE,
    panel,
    result_panel,
    to_bytes,
    write_animation,
    write_png,
)
from nerf_lightning.system import ViewResult


def flat(height: int, width: int, level: int) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)


def test_bytes_are_rounded_and_held():
    image = torch.tensor([[[-1.0, 0.0, 0.499 / 255], [0.501 / 255, 1.0, 2.0]]])
    assert to_bytes(image).tolist() == [[[0, 0, 0], [1, 255, 255]]]


@pytest.mark.parametrize(
    ("height", "width", "magnify"), [(160, 90, 1), (400, 300, 1), (159, 90, 2), (24, 40, 7), (1, 2, 160)]
)
def test_images_stand_side_by_side_above_the_caption(height, width, magnify):
    images = [flat(height, width, level) for level in (50, 100, 200)]
    images[0][0, 0] = 7
    made = panel(images, "step 10, 3.2 dB")
    above = height * magnify
    assert above >= SMALLEST_SIDE and made.shape[1] == 3 * width * magnify
    assert 10 < made.shape[0] - above < 40, "a strip for the caption"
    assert (made[:magnify, :magnify] == 7).all(), "hard edges"
    for i, level in enumerate((50, 100, 200)):
        column = int((i + 0.5) * width * magnify)
        assert (made[above - 1, column] == level).all()
    strip = made[above:]
    assert (np.median(strip) == 24) and strip.max() > 60, "light letters on dark"


@pytest.mark.parametrize("caption", ["short", "a caption far too long for a picture this narrow " * 3, "Grüße, 3 °"])
def test_captions_fit(caption):
    strip = panel([flat(160, 60, 0)] * 3, caption)[160:]
    assert (strip > 60).any()
    assert (strip[:, -4:] == 24).all() and (strip[:, :3] == 24).all(), "nothing is cut off"


@pytest.mark.parametrize("with_depth", [True, False])
def test_a_result_shows_truth_render_and_depth_or_error(with_depth):
    rgb, truth = torch.full((200, 100, 3), 0.5), torch.full((200, 100, 3), 0.4)
    maps = (torch.ones(200, 100), torch.ones(200, 100)) if with_depth else (None, None)
    made = result_panel(ViewResult(rgb, truth, 20.0, 1.0, *maps), "caption")
    assert (made[100, 50] == 102).all() and (made[100, 150] == 128).all()
    third = colorize_depth(np.ones(1), 1.0, 2.0)[0] if with_depth else 102  # four times 0.1
    assert (made[100, 250] == third).all()


def test_large_pictures_are_shrunk_to_stand_beside_others(monkeypatch):
    monkeypatch.setattr("nerf_lightning.drawing.panels.PANEL_PX", 50)
    rgb = torch.zeros(400, 100, 3)
    rgb[::2] = 1.0
    made = result_panel(ViewResult(rgb, rgb, 20.0, 1.0), "caption")
    assert made.shape[1] == 150 and (made[:200, :100] == 128).all()


def test_a_picture_is_written_whole(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (5, 7, 3)).astype(np.uint8)
    write_png(tmp_path / "new" / "a.png", image)
    assert np.array_equal(imageio.imread(tmp_path / "new" / "a.png"), image)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.png"]


def test_an_animation_is_written_while_its_frames_are_drawn(tmp_path: Path):
    alive: list[weakref.ref] = []

    def frames() -> Iterator[np.ndarray]:
        for level in (0, 80, 160, 240):
            assert sum(one() is not None for one in alive) <= 1, "each frame goes once it is written"
            frame = np.full((6, 8, 3), level, np.uint8)
            alive.append(weakref.ref(frame))
            yield frame

    write_animation(tmp_path / "a.gif", frames(), 0.2)
    assert len(alive) == 4
    assert imageio.imread(tmp_path / "a.gif", mode="RGB")[:, 3, 4, 1].tolist() == [0, 80, 160, 240]
    about = imageio.immeta(tmp_path / "a.gif")
    assert about["duration"] == 200 and about["loop"] == 0
    write_animation(tmp_path / "a.webp", [np.zeros((6, 8, 4), np.uint8)], 0.2)
    assert imageio.imread(tmp_path / "a.webp", mode="RGBA").shape[-3:] == (6, 8, 4), "a single one, transparent"
