"""Features that are the same in several photos, and where they lie."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import inverse

Keypoint = tuple[int, int]
"""The photo's number, and the feature's in it."""
NARROWEST = np.radians(2.0)
"""Angle between two lines of sight below which the point's distance is a guess."""


def linked(matches: Sequence[tuple[Keypoint, Keypoint]]) -> list[list[Keypoint]]:
    """Tracks: features joined by matches, directly or through others. Those with two features of one photo are mistakes, and
    are left out."""
    parent: dict[Keypoint, Keypoint] = {}

    def root(key: Keypoint) -> Keypoint:
        while parent.setdefault(key, key) != key:
            parent[key] = parent[parent[key]]
            key = parent[key]
        return key

    for a, b in matches:
        parent[root(a)] = root(b)
    tracks: dict[Keypoint, list[Keypoint]] = defaultdict(list)
    for key in sorted(parent):
        tracks[root(key)].append(key)
    return [track for track in tracks.values() if len({photo for photo, _ in track}) == len(track)]


def triangulated(
    tracks: Sequence[list[Keypoint]],
    tangents: Sequence[Float[np.ndarray, "_ 2"]],
    w2c: Mapping[int, Float[np.ndarray, "4 4"]],
    limit: float,
) -> list[tuple[list[Keypoint], Float[np.ndarray, "3"]]]:
    """Points that the placed photos of a track agree on.

    The feature that is farthest off is dropped until all agree (Hartley and Zisserman 2004, section 12.2: linear
    triangulation).

    Args:
        tracks: see `linked`.
        tangents: x / z and y / z of the features, by photo.
        w2c: world to camera of the placed photos, by number.
        limit: largest distance of x / z and y / z.

    Returns:
        Tracks, and their points in the world.
    """
    centres = {photo: inverse(pose)[:3, 3] for photo, pose in w2c.items()}
    out = []
    for track in tracks:
        seen = [key for key in track if key[0] in w2c]
        while len(seen) >= 2:
            poses = np.stack([w2c[photo][:3] for photo, _ in seen])
            at = np.stack([tangents[photo][k] for photo, k in seen])
            point = _intersection(poses, at)
            there = np.einsum("nij,j->ni", poses, np.append(point, 1.0))
            off = np.linalg.norm(there[:, :2] / there[:, 2:] - at, axis=1)
            off[there[:, 2] <= 0] = np.inf
            if off.max() < limit:
                if _widest(np.stack([centres[photo] for photo, _ in seen]) - point) > NARROWEST:
                    out.append((track, point))
                break
            del seen[int(off.argmax())]
    return out


def _intersection(poses: Float[np.ndarray, "V 3 4"], tangents: Float[np.ndarray, "V 2"]) -> Float[np.ndarray, "3"]:
    rows = tangents[:, :, None] * poses[:, 2:] - poses[:, :2]
    flat = rows.reshape(-1, 4)
    return np.linalg.lstsq(flat[:, :3], -flat[:, 3], rcond=None)[0]


def _widest(toward: Float[np.ndarray, "V 3"]) -> float:
    """The largest angle between directions, radians."""
    unit = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    return float(np.arccos(np.clip((unit @ unit.T).min(), -1, 1)))
