"""ChArUco boards: a chessboard with tags in its white squares, taken as one large mark."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from nerf_lightning.capture.tags.detect import Detector, TagDetection, get_dictionary
from nerf_lightning.errors import InputError

MIN_CORNERS = 6
"""Corners that a photo must show: four fix a pose, more show when it is wrong."""


@dataclass(frozen=True)
class Board:
    """A chessboard of `columns` x `rows` squares, at least 3 each, of side `square`, metres."""

    columns: int
    rows: int
    square: float


def make_board_detector(dictionary: str, size: float, board: Board) -> Detector:
    """A detector of one board, whose inner corners become mark 0.

    The board's own frame has its origin in the middle, x to the printed right, y to the printed top, z toward the reader.

    Args:
        dictionary: OpenCV's name of the tags' family.
        size: side of the tags, metres.

    Raises:
        InputError: tags that do not fit into the squares, or more white squares than the family has tags.
    """
    if not size < board.square:
        raise InputError("capture", "board_square", f"{board.square:g}", f"more than tag_size, which is {size:g}")
    patterns = get_dictionary(dictionary)
    white = board.columns * board.rows // 2
    if white > len(patterns.bytesList):
        found = f"{board.columns} x {board.rows}, which takes {white} tags"
        raise InputError("capture", "board_columns", found, f"at most the {len(patterns.bytesList)} of {dictionary}")
    detectors = []
    for legacy in (False, True):  # boards made before OpenCV 4.6 may begin with a white square
        made = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, size, patterns)
        made.setLegacyPattern(legacy)
        detectors.append((cv2.aruco.CharucoDetector(made), np.asarray(made.getChessboardCorners(), np.float64)))
    middle = board.square * np.array([board.columns / 2, board.rows / 2, 0])

    def detect(grey: UInt8[np.ndarray, "H W"]) -> dict[int, TagDetection]:
        for detector, corners in detectors:
            pixels, ids, _, _ = detector.detectBoard(grey)
            if ids is None or len(ids) < MIN_CORNERS:
                continue
            # OpenCV's y runs down the print, and its z into the paper.
            points = (corners[np.asarray(ids).reshape(-1)] - middle) * [1, -1, -1]
            if np.linalg.matrix_rank(points[:, :2] - points[0, :2], tol=board.square / 2) < 2:
                continue  # corners in one row fix no pose
            # OpenCV puts pixel centres at integers.
            return {0: TagDetection(points, np.asarray(pixels, np.float64).reshape(-1, 2) + 0.5)}
        return {}

    return detect
