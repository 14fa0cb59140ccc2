"""Tag layouts: dictionary, size and world poses of printed tags."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerf_lightning.dataset.formats.checks import MAX_COORDINATE
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_yaml

UNIT_SQUARE = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) / 2
"""Corners of a tag of side 1 in the tag's frame, in OpenCV's order: the printed top left first, then clockwise."""
SHEETS_FOLDER = Path(__file__).parent / "sheets"


@dataclass(frozen=True)
class TagLayout:
    """Tags in the world frame, meters: that of one tag, or of the printed sheet.

    A tag's frame: origin at the center of the black square, x to the printed right, y to the printed top, z out of the paper.
    """

    dictionary: str
    """OpenCV's name of the tag family, such as "DICT_4X4_50"."""
    size: float
    """Side of the black square."""
    poses: dict[int, Float[np.ndarray, "4 4"]]
    """Tag to world, by tag id."""

    def corners(self, tag: int) -> Float[np.ndarray, "4 3"]:
        """World corners of a tag, in the order of `UNIT_SQUARE`."""
        pose = self.poses[tag]
        return self.size * UNIT_SQUARE @ pose[:3, :3].T + pose[:3, 3]


def flat_pose(x: float, y: float, degrees: float = 0.0) -> Float[np.ndarray, "4 4"]:
    """Pose of a tag in the plane z = 0, centered at (x, y) and rotated counterclockwise."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64)


def read_layout(path: Path, dictionary: str, size: float) -> TagLayout:
    """Reads a planar layout: `tags: {id: {x: meters, y: meters, turn: degrees}}`; `turn` is optional.

    Args:
        path: a YAML file, or the name of one in the package ("sheet_2x3").
        dictionary, size: see `TagLayout`.

    Raises:
        InputError: a missing file, a file that is not YAML, or entries that are not numbers.
    """
    bundled = SHEETS_FOLDER / f"{path.name}.yaml"
    if not path.exists() and path.parent == Path() and bundled.exists():
        path = bundled
    content = read_yaml(path, "a file with tags: {0: {x: 0.0, y: 0.0}}")
    tags = content.get("tags") if isinstance(content, dict) else None
    if not isinstance(tags, dict) or not tags:
        raise InputError(path, "tags", repr(tags), "a mapping from each tag's id to its x and y in meters")
    poses = {}
    for tag, entry in tags.items():
        given = {"turn": 0.0} | (entry if isinstance(entry, dict) else {})
        is_number = [type(number) in (int, float) and abs(number) <= MAX_COORDINATE for number in given.values()]
        if type(tag) is not int or tag < 0 or set(given) != {"x", "y", "turn"} or not all(is_number):
            expected = "an id with x and y in meters, and optionally turn in degrees"
            raise InputError(path, f"tags.{tag}", repr(entry), expected)
        poses[tag] = flat_pose(given["x"], given["y"], given["turn"])
    return TagLayout(dictionary, size, poses)
