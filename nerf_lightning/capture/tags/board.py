"""ChArUco boards: a chessboard with tags in its white squares, detected as one large tag."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from nerf_lightning.capture.tags.detect import Detector, TagDetection, get_dictionary
from nerf_lightning.errors import InputError

MIN_CORNERS = 6
"""Fewest corners per photo: four determine a pose, more reveal a wrong one."""


@dataclass(frozen=True)
class Board:
    """A ChArUco board of `columns` x `rows` squares, at least 3 each, of side `square`, meters."""

    columns: int
    rows: int
    square: float


def make_board_detector(dictionary: str, size: float, board: Board) -> Detector:
    """Makes a detector of a ChArUco board, whose inner corners become tag 0.

    The board's frame: origin at its center, x to the printed right, y to the printed top, z out of the paper.

    Args:
        dictionary: OpenCV's name of the tag family.
        size: side of the tags, meters.

    Raises:
        InputError: the tags do not fit into the squares, or the family has too few of them.
    """
    if not size < board.square:
        raise InputError("capture", "board_square", f"{board.square:g}", f"more than tag_size, which is {size:g}")
    patterns = get_dictionary(dictionary)
    num_tags = board.columns * board.rows // 2
    if num_tags > len(patterns.bytesList):
        problem = f"{board.columns} x {board.rows}, which needs {num_tags} tags"
        raise InputError("capture", "board_columns", problem, f"at most the {len(patterns.bytesList)} of {dictionary}")
    detectors = []
    for legacy in (False, True):  # OpenCV before 4.6 starts boards with a white square
        charuco = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, size, patterns)
        charuco.setLegacyPattern(legacy)
        detectors.append((cv2.aruco.CharucoDetector(charuco), np.asarray(charuco.getChessboardCorners(), np.float64)))
    center = board.square * np.array([board.columns / 2, board.rows / 2, 0])

    def detect(gray: UInt8[np.ndarray, "H W"]) -> dict[int, TagDetection]:
        for detector, corners in detectors:
            pixels, ids, _, _ = detector.detectBoard(gray)
            if ids is None or len(ids) < MIN_CORNERS:
                continue
            # OpenCV's y points down the print, and its z into the paper.
            points = (corners[np.asarray(ids).reshape(-1)] - center) * [1, -1, -1]
            if np.linalg.matrix_rank(points[:, :2] - points[0, :2], tol=board.square / 2) < 2:
                continue  # collinear corners do not determine a pose
            # OpenCV puts pixel centers at integers.
            return {0: TagDetection(points, np.asarray(pixels, np.float64).reshape(-1, 2) + 0.5)}
        return {}

    return detect
