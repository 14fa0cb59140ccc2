from pathlib import Path

import cv2
import numpy as np
import pytest

from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import angle_between, invert_pose, project_points
from nerf_lightning.capture.tags.board import Board, make_board_detector
from nerf_lightning.capture.tags.detect import PhotoObservation
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.errors import InputError
from tests.helpers.tag_views import make_pose

LENS = Intrinsics(640, 480, 600.0, 600.0, 320.0, 240.0)
BOARD, TAG, FAMILY = Board(5, 7, 0.03), 0.022, "DICT_4X4_50"
CELL = 80
"""Pixels per square in the print."""


def printed(board: Board, legacy: bool = False) -> np.ndarray:
    made = cv2.aruco.CharucoBoard(
        (board.columns, board.rows), board.square, TAG, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    made.setLegacyPattern(legacy)
    return made.generateImage((CELL * board.columns, CELL * board.rows))


def photo(print_: np.ndarray, board: Board, c2w: np.ndarray) -> np.ndarray:
    """Photo of the print without distortion; x right and y up from its center."""
    w2c = invert_pose(c2w)
    height, width = print_.shape
    step = board.square / CELL
    to_world = np.array([[step, 0, -step * width / 2], [0, -step, step * height / 2], [0, 0, 1]])
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV's pixel centers are integers
    H = np.linalg.inv(half) @ LENS.K @ w2c[:3][:, [0, 1, 3]] @ to_world @ half
    # Drawn large and averaged down, so that edges are smooth.
    grown = np.diag([4.0, 4.0, 1.0])
    shift = np.array([[1, 0, 1.5], [0, 1, 1.5], [0, 0, 1]])
    big = cv2.warpPerspective(print_, shift @ grown @ H, (4 * LENS.width, 4 * LENS.height), borderValue=200)
    return cv2.resize(big, (LENS.width, LENS.height), interpolation=cv2.INTER_AREA)


def eyes(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    places = [(0.22 * np.cos(t), 0.22 * np.sin(t)) for t in np.linspace(0, 2 * np.pi, count, endpoint=False)]
    return [make_pose([x, y, 0.26 + 0.05 * rng.random()], [0, 0, 0], 0.3 * rng.standard_normal()) for x, y in places]


@pytest.mark.parametrize("legacy", [False, True])
def test_make_board_detector_finds_corners_where_they_project(legacy: bool):
    board = Board(5, 6, 0.03)  # with an even number of rows old and new boards differ
    detect = make_board_detector(FAMILY, TAG, board)
    errors = []
    for c2w in eyes(8):
        (detection,) = detect(photo(printed(board, legacy), board, c2w)).values()
        assert len(detection.points) == 4 * 5 and not detection.points[:, 2].any()
        errors.append(detection.pixels - project_points(LENS, invert_pose(c2w), detection.points))
    flat = np.concatenate(errors)
    assert np.abs(flat).max() < 0.5 and np.abs(flat.mean(0)).max() < 0.1


def test_calibrate_with_board_finds_lens_and_poses():
    detect, c2ws = make_board_detector(FAMILY, TAG, BOARD), eyes(8)
    photos = [photo(printed(BOARD), BOARD, c2w) for c2w in c2ws]
    seen = [PhotoObservation(Path(f"{i}.png"), LENS.width, LENS.height, detect(gray)) for i, gray in enumerate(photos)]
    found = calibrate(Path("board"), seen, None)
    assert abs(found.lens.fx / LENS.fx - 1) < 0.003 and found.rms < 0.2
    for w2c, c2w in zip(found.solution.w2c.values(), c2ws, strict=True):
        assert angle_between(invert_pose(w2c), c2w) < np.radians(0.5)
    assert detect(np.full((480, 640), 128, np.uint8)) == {}  # no board


def test_make_board_detector_of_impossible_size_raises():
    for board, key in ((Board(5, 7, 0.02), "board_square"), (Board(12, 12, 0.03), "board_columns")):
        with pytest.raises(InputError, match=key):
            make_board_detector(FAMILY, TAG, board)
