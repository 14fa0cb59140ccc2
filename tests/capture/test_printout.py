from pathlib import Path

import cv2
import numpy as np
import pytest

from nerf_lightning.capture.tags.detect import make_tag_detector
from nerf_lightning.capture.tags.printout import A4_METERS, draw_sheet, write_sheet_pdf
from nerf_lightning.capture.tags.tag_layout import TagLayout, flat_pose, read_layout
from nerf_lightning.cli.capture import print_tags
from nerf_lightning.drawing.style import rasterize_figure
from nerf_lightning.errors import InputError


@pytest.mark.parametrize(
    "layout",
    [
        read_layout(Path("sheet_2x3"), "DICT_4X4_50", 0.06),
        TagLayout("DICT_6X6_250", 0.05, {7: flat_pose(0, 0, 30), 11: flat_pose(0.08, 0.02, -90)}),
    ],
)
def test_draw_sheet_of_layout_shows_tags_at_their_positions(layout: TagLayout):
    image = cv2.cvtColor(rasterize_figure(draw_sheet(layout)), cv2.COLOR_RGB2GRAY)
    height, width = image.shape
    assert width / height == pytest.approx(A4_METERS[0] / A4_METERS[1], rel=0.01)
    found = make_tag_detector(layout.dictionary, layout.size)(image)
    assert sorted(found) == sorted(layout.poses)
    scale = width / A4_METERS[0]
    corners = {tag: layout.corners(tag)[:, :2] * [1, -1] * scale for tag in layout.poses}
    every = np.concatenate(list(corners.values()))
    shift = [width / 2, height / 2] - (every.min(0) + every.max(0)) / 2
    for tag, mark in found.items():
        np.testing.assert_allclose(mark.pixels, corners[tag] + shift, atol=1.5)  # edges snap to pixels


def test_print_tags_writes_pdf_or_raises(tmp_path: Path):
    print_tags(tmp_path / "sheet.pdf")
    assert (tmp_path / "sheet.pdf").read_bytes()[:5] == b"%PDF-"
    with pytest.raises(InputError, match=".pdf"):
        print_tags(tmp_path / "sheet.png")
    wide = TagLayout("DICT_4X4_50", 0.06, {0: flat_pose(0, 0), 1: flat_pose(0.16, 0)})
    with pytest.raises(InputError, match="220 x 60 mm"):
        write_sheet_pdf(wide, tmp_path / "a.pdf")
    beyond = TagLayout("DICT_4X4_50", 0.02, {0: flat_pose(0, 0), 50: flat_pose(0.04, 0)})
    with pytest.raises(InputError, match="tag 50"):
        write_sheet_pdf(beyond, tmp_path / "a.pdf")
    assert len(list(tmp_path.iterdir())) == 1
