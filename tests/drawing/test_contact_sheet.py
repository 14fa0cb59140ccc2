import numpy as np

from nerf_lightning.drawing.contact_sheet import GAP, contact_sheet
from nerf_lightning.drawing.ink import VERMILLION, rgb


def flat(height: int, width: int, level: int) -> np.ndarray:
    return np.full((height, width, 3), (level, 0, level), np.uint8)


def where(sheet: np.ndarray, level: int) -> np.ndarray:
    return (sheet == (level, 0, level)).all(-1)


def test_contact_sheet_images_are_laid_out_row_by_row():
    levels = (40, 80, 120)
    sheet = contact_sheet([flat(30, 40, level) for level in levels], ["one", "two", "three"], columns=2, width=300)
    cell = (300 - GAP) // 2 - GAP
    tops = {level: np.argwhere(where(sheet, level)).min(0).tolist() for level in levels}
    assert tops[40] == [GAP, GAP] and tops[80] == [GAP, 2 * GAP + cell]
    assert tops[120][1] == GAP and tops[120][0] > GAP + round(cell * 3 / 4)
    assert where(sheet, 40)[GAP : GAP + round(cell * 3 / 4), GAP : GAP + cell].all(), "scaled to its cell"
    below = sheet[GAP + round(cell * 3 / 4) : tops[120][0]]
    assert below[:, : GAP + cell].min() < 100 and below[:, GAP + cell :].min() < 100, "captions below both"


def test_contact_sheet_flagged_image_has_an_outline_and_a_missing_one_a_grey_box():
    sheet = contact_sheet([flat(30, 40, 40), None], ["good", "lost"], columns=2, width=300, flagged=[1])
    cell = (300 - GAP) // 2 - GAP
    assert (sheet[GAP + 20, 2 * GAP + cell + 20] == 221).all()
    marked = np.argwhere((sheet == rgb(VERMILLION)).all(-1))
    assert marked[:, 1].min() == 2 * GAP + cell - 4, "around the second alone"


def test_contact_sheet_without_width_keeps_sizes_and_heading_comes_first():
    images = [flat(20, 30, 40), flat(10, 50, 80)]
    sheet = contact_sheet(images, ["", ""], columns=1)
    assert sheet.shape[1] == 50 + 2 * GAP
    assert [int(where(sheet, level).sum()) for level in (40, 80)] == [600, 500]
    titled = contact_sheet(images, ["", ""], columns=1, heading="title")
    assert titled.shape[0] > sheet.shape[0] and titled[: titled.shape[0] - sheet.shape[0]].min() < 100
