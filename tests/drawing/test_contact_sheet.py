import numpy as np

from nerf_lightning.drawing.contact_sheet import GAP_PX, make_contact_sheet
from nerf_lightning.drawing.style import VERMILLION, parse_hex_color


def flat(height: int, width: int, level: int) -> np.ndarray:
    return np.full((height, width, 3), (level, 0, level), np.uint8)


def bounding_box(sheet: np.ndarray, level: int) -> np.ndarray:
    return (sheet == (level, 0, level)).all(-1)


def test_make_contact_sheet_lays_out_images_row_by_row():
    levels = (40, 80, 120)
    sheet = make_contact_sheet([flat(30, 40, level) for level in levels], ["one", "two", "three"], columns=2, width=300)
    cell = (300 - GAP_PX) // 2 - GAP_PX
    tops = {level: np.argwhere(bounding_box(sheet, level)).min(0).tolist() for level in levels}
    assert tops[40] == [GAP_PX, GAP_PX] and tops[80] == [GAP_PX, 2 * GAP_PX + cell]
    assert tops[120][1] == GAP_PX and tops[120][0] > GAP_PX + round(cell * 3 / 4)
    assert bounding_box(sheet, 40)[GAP_PX : GAP_PX + round(cell * 3 / 4), GAP_PX : GAP_PX + cell].all(), "scaled"
    below = sheet[GAP_PX + round(cell * 3 / 4) : tops[120][0]]
    assert below[:, : GAP_PX + cell].min() < 100 and below[:, GAP_PX + cell :].min() < 100, "captions below both"


def test_make_contact_sheet_outlines_flagged_and_grays_missing_images():
    sheet = make_contact_sheet([flat(30, 40, 40), None], ["good", "lost"], columns=2, width=300, flagged=[1])
    cell = (300 - GAP_PX) // 2 - GAP_PX
    assert (sheet[GAP_PX + 20, 2 * GAP_PX + cell + 20] == 221).all()
    marked = np.argwhere((sheet == parse_hex_color(VERMILLION)).all(-1))
    assert marked[:, 1].min() == 2 * GAP_PX + cell - 4, "around the second alone"


def test_make_contact_sheet_without_width_keeps_sizes_below_heading():
    images = [flat(20, 30, 40), flat(10, 50, 80)]
    sheet = make_contact_sheet(images, ["", ""], columns=1)
    assert sheet.shape[1] == 50 + 2 * GAP_PX
    assert [int(bounding_box(sheet, level).sum()) for level in (40, 80)] == [600, 500]
    titled = make_contact_sheet(images, ["", ""], columns=1, heading="title")
    assert titled.shape[0] > sheet.shape[0] and titled[: titled.shape[0] - sheet.shape[0]].min() < 100
