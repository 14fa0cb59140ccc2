from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.drawing.panels import (
    colorize_depth,
    make_panel,
    make_result_panel,
    to_uint8,
    write_animation,
)
from nerf_lightning.system import ViewResult


def flat(height: int, width: int, level: int) -> np.ndarray:
    return np.full((height, width, 3), level, np.uint8)


def test_to_uint8_rounds_and_clamps():
    image = torch.tensor([[[-1.0, 0.0, 0.499 / 255], [0.501 / 255, 1.0, 2.0]]])
    assert to_uint8(image).tolist() == [[[0, 0, 0], [1, 255, 255]]]


@pytest.mark.parametrize(("height", "width", "magnify"), [(160, 90, 1), (24, 40, 7)])
def test_make_panel_puts_images_side_by_side_above_caption(height: int, width: int, magnify: int):
    images = [flat(height, width, level) for level in (50, 100, 200)]
    images[0][0, 0] = 7
    made = make_panel(images, "a caption, in Grüße, far too long for a picture this narrow " * 3)
    above, strip = made[: height * magnify], made[height * magnify :]
    assert (above[:magnify, :magnify] == 7).all(), "hard edges"
    assert above[-1, [int((i + 0.5) * width * magnify) for i in range(3)], 0].tolist() == [50, 100, 200]
    assert made.shape[1] == 3 * width * magnify and 10 < len(strip) < 40
    assert strip.max() > 60 and (strip[:, -4:] == 24).all() and (strip[:, :3] == 24).all(), "nothing is cut off"


@pytest.mark.parametrize("with_depth", [True, False])
def test_make_result_panel_shows_truth_render_and_depth_or_error(with_depth):
    rgb, truth = torch.full((200, 100, 3), 0.5), torch.full((200, 100, 3), 0.4)
    maps = (torch.ones(200, 100), torch.ones(200, 100)) if with_depth else (None, None)
    made = make_result_panel(ViewResult(rgb, truth, 20.0, 1.0, *maps), "caption")
    assert (made[100, 50] == 102).all() and (made[100, 150] == 128).all()
    third = colorize_depth(np.ones(1), 1.0, 2.0)[0] if with_depth else 102  # four times 0.1
    assert (made[100, 250] == third).all()


def test_write_animation_repeats_its_frames(tmp_path: Path):
    write_animation(tmp_path / "a.gif", (flat(6, 8, level) for level in (0, 80, 160, 240)), 0.2)
    assert imageio.imread(tmp_path / "a.gif", mode="RGB")[:, 3, 4, 1].tolist() == [0, 80, 160, 240]
    about = imageio.immeta(tmp_path / "a.gif")
    assert about["duration"] == 200 and about["loop"] == 0
    write_animation(tmp_path / "a.webp", [np.zeros((6, 8, 4), np.uint8)], 0.2)
    assert imageio.imread(tmp_path / "a.webp", mode="RGBA").shape[-3:] == (6, 8, 4), "a single one, transparent"
