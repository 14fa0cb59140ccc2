"""Tag detection in photos: ids and subpixel corners."""

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from nerf_lightning.capture.tags.tag_layout import UNIT_SQUARE
from nerf_lightning.dataset.formats.image_files import read_pixels
from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.errors import InputError
from nerf_lightning.utils.progress import track_progress
from nerf_lightning.utils.text import subsample

COMMON_DICTIONARIES = (
    *(f"DICT_{side}X{side}_{count}" for count in (50, 1000) for side in (4, 5, 6, 7)),
    *("DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11", "DICT_APRILTAG_25h9", "DICT_APRILTAG_16h5"),
)
"""Families that `auto` tries, small ones first: each holds the first patterns of its larger one."""
GUESS_SIDE_PX = 1600
"""Longest side of the photos in which `auto` looks for a family."""
NUM_THREADS = 2


@dataclass(frozen=True)
class TagDetection:
    """Corners of one tag (or board) and their pixels in a photo."""

    points: Float[np.ndarray, "M 3"]
    """In the tag's frame, meters."""
    pixels: Float[np.ndarray, "M 2"]
    """Pixel centers at +0.5."""


@dataclass(frozen=True)
class PhotoObservation:
    """A photo's size and detected tags."""

    path: Path
    width: int
    height: int
    detections: dict[int, TagDetection]
    """By tag id."""

    @property
    def name(self) -> str:
        return self.path.name


Detector = Callable[[UInt8[np.ndarray, "H W"]], dict[int, TagDetection]]
"""Detects tags in a gray photo, by id."""


def get_dictionary(name: str) -> "cv2.aruco.Dictionary":
    """OpenCV's predefined tag dictionary of this name.

    Raises:
        InputError: OpenCV has no such dictionary.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if number is None:
        raise InputError("capture", "dictionary", name, f"auto, or a name such as {', '.join(COMMON_DICTIONARIES[:4])}")
    return cv2.aruco.getPredefinedDictionary(number)


def make_tag_detector(dictionary: str, size: float) -> Detector:
    """Makes a detector of single square tags, with corners refined by `cornerSubPix`.

    OpenCV puts pixel centers at integers, so half a pixel is added.

    Args:
        dictionary: OpenCV's name of the tag family.
        size: side of the black square, meters.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 30  # OpenCV caps it at 0.3 modules; modules are large in sharp photos
    parameters.cornerRefinementMinAccuracy = 0.005
    parameters.cornerRefinementMaxIterations = 100
    detector = cv2.aruco.ArucoDetector(get_dictionary(dictionary), parameters)

    def detect(gray: UInt8[np.ndarray, "H W"]) -> dict[int, TagDetection]:
        corners, ids, _ = detector.detectMarkers(gray)
        tags = [] if ids is None else [int(i) for i in np.asarray(ids).reshape(-1)]
        duplicates = {tag for tag, count in Counter(tags).items() if count > 1}
        # A tag detected twice is a reflection, a second print or a false positive: both are ambiguous.
        return {
            tag: TagDetection(size * UNIT_SQUARE, np.asarray(four, np.float64).reshape(4, 2) + 0.5)
            for tag, four in zip(tags, corners, strict=True)
            if tag not in duplicates
        }

    return detect


def read_gray(path: Path) -> UInt8[np.ndarray, "H W"]:
    """Reads a photo, upright, in gray."""
    return cv2.cvtColor(read_pixels(path, upright=True)[..., :3], cv2.COLOR_RGB2GRAY)


def detect_tags(paths: Sequence[Path], detector: Detector) -> list[PhotoObservation]:
    """Detects tags in photos, in the given order."""

    def observe(path: Path) -> PhotoObservation:
        gray = read_gray(path)
        return PhotoObservation(path, gray.shape[1], gray.shape[0], detector(gray))

    with ThreadPoolExecutor(NUM_THREADS) as pool:
        return list(track_progress(pool.map(observe, paths), len(paths), "detecting tags"))


def find_wrong_sizes(
    folder: Path, photos: Sequence[PhotoObservation], size: tuple[int, int] | None = None
) -> dict[str, str]:
    """Reasons by name of the photos without the most common size (or `size`, that of the calibration).

    Raises:
        InputError: no photo has that size.
    """
    width, height = size or Counter((p.width, p.height) for p in photos).most_common(1)[0][0]
    expected = f"{'the calibration has' if size else 'most have'} {width}x{height}"
    wrong = {}
    for photo in photos:
        if (photo.width, photo.height) != (width, height):
            problem = "rotated by 90 degrees" if (photo.height, photo.width) == (width, height) else "of another size"
            wrong[photo.name] = f"{photo.width}x{photo.height} pixels, {problem}: {expected}"
    if len(wrong) == len(photos):
        name, reason = next(iter(wrong.items()))
        advice = "take both with one camera in one orientation, without zooming"
        raise InputError(folder / name, "", reason, "photos of the size and orientation of the calibration", advice)
    return wrong


def guess_dictionary(paths: Sequence[Path], photos: int = 4) -> str:
    """The tag family with the most detections in a few of the photos.

    Raises:
        InputError: no tag of a common family is detected.
    """
    reduced = []
    for i in subsample(len(paths), photos):
        gray = read_gray(paths[i])
        size = fit_size(gray.shape[1], gray.shape[0], GUESS_SIDE_PX)
        reduced.append(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))
    counts = {}
    for name in COMMON_DICTIONARIES:
        # Without error correction, which would turn clutter into tags of the larger families.
        parameters = cv2.aruco.DetectorParameters()
        parameters.errorCorrectionRate = 0.0
        detector = cv2.aruco.ArucoDetector(get_dictionary(name), parameters)
        counts[name] = sum(len(detector.detectMarkers(gray)[0]) for gray in reduced)
    best = max(COMMON_DICTIONARIES, key=counts.__getitem__)
    if not counts[best]:
        problem = f"no tag of a common family in {len(reduced)} of {len(paths)} photos"
        advice = "take sharp photos of tags with a white margin, or name their family with dictionary"
        raise InputError(paths[0].parent, "", problem, hint=advice)
    return best
