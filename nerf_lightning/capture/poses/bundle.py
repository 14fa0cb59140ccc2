"""Lens, camera poses and tag poses together: reprojection residuals and their derivatives."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix

from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.geometry import to_matrix
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.dataset.intrinsics import Intrinsics

LENS_PARAMETERS = ("focal", "aspect", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""fx = focal, fy = focal * aspect; distortion in OpenCV's order."""


@dataclass(frozen=True)
class Bundle:
    """All unknowns, and the marks that were seen.

    Photos and tags are numbered; `marks[p]` maps a tag's number to its mark in photo p.
    """

    lens: Intrinsics
    w2c: Float[np.ndarray, "P 4 4"]
    """World to camera, by photo."""
    tags: Float[np.ndarray, "T 4 4"]
    """Tag to world, by tag."""
    marks: list[dict[int, Mark]]
    twists: Float[np.ndarray, "T"]
    """How far the corners of each tag stand out of its plane, alternately up and down, metres: paper is seldom flat."""


def lens_vector(lens: Intrinsics) -> Float[np.ndarray, "9"]:
    return np.array([lens.fx, lens.fy / lens.fx, lens.cx, lens.cy, *lens.opencv])


def lens_with(lens: Intrinsics, vector: Float[np.ndarray, "9"]) -> Intrinsics:
    focal, aspect, cx, cy, *distortion = (float(v) for v in vector)
    k1, k2, p1, p2, k3 = distortion
    return replace(
        lens, fx=focal, fy=focal * aspect, cx=cx, cy=cy, distortion=Distortion(k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)
    )


def simplified(lens: Intrinsics, free: tuple[str, ...]) -> Intrinsics:
    """The lens with plain values (square pixels, centred, no distortion) for what is not free; unchanged for ()."""
    if not free:
        return lens
    plain = np.array([lens.fx, 1.0, lens.width / 2, lens.height / 2, 0, 0, 0, 0, 0])
    kept = np.array([name in free for name in LENS_PARAMETERS])
    return lens_with(lens, np.where(kept, lens_vector(lens), plain))


def _warp(points: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M"]:
    """How high a twist by 1 lifts each point: x y, 1 at the corners. Only this bend of a square lifts its corners out of their
    common plane."""
    extent = np.abs(points[:, :2]).max(0)
    return points[:, 0] * points[:, 1] / (extent[0] * extent[1])


def _rotations(vectors: Float[np.ndarray, "B 3"]) -> tuple[Float[np.ndarray, "B 3 3"], Float[np.ndarray, "B 3 3 3"]]:
    """Matrices of rotation vectors, and their derivatives with respect to each of the three numbers."""
    matrices, derivatives = np.empty((len(vectors), 3, 3)), np.empty((len(vectors), 3, 3, 3))
    for index, vector in enumerate(vectors):
        matrices[index], derivative = cv2.Rodrigues(vector)
        # OpenCV 4 and 5 give the derivative of the nine entries in rows or in columns of three.
        by_number = derivative if derivative.shape == (3, 9) else derivative.T
        derivatives[index] = by_number.reshape(3, 3, 3)
    return matrices, derivatives


def _moved(
    motions: Float[np.ndarray, "B 6"], which: Int[np.ndarray, "N"], points: Float[np.ndarray, "N 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 6"], Float[np.ndarray, "N 3 3"]]:
    """Points moved by motion `which`, the derivatives with respect to its six numbers, and its rotation matrix."""
    turns, derivatives = _rotations(motions[:, :3])
    jacobian = np.empty((len(points), 3, 6))
    jacobian[:, :, :3] = np.einsum("nkrc,nc->nrk", derivatives[which], points)
    jacobian[:, :, 3:] = np.eye(3)
    turn = turns[which]
    return np.einsum("nrc,nc->nr", turn, points) + motions[which, 3:], jacobian, turn


def _turned(motion: Float[np.ndarray, "6"], pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """A pose turned further, at its new place."""
    out = to_matrix(motion)
    out[:3, :3] = out[:3, :3] @ pose[:3, :3]
    return out


@dataclass(frozen=True)
class _Seen:
    """All points seen, photo by photo and mark by mark."""

    photo: Int[np.ndarray, "N"]
    tag: Int[np.ndarray, "N"]
    points: Float[np.ndarray, "N 3"]
    """In the tag's own frame, metres."""
    warp: Float[np.ndarray, "N"]
    pixels: Float[np.ndarray, "N 2"]

    @staticmethod
    def of(marks: list[dict[int, Mark]]) -> "_Seen":
        flat = [(photo, tag, mark) for photo, found in enumerate(marks) for tag, mark in found.items()]
        counts = [len(mark.points) for _, _, mark in flat]
        return _Seen(
            np.repeat([photo for photo, _, _ in flat], counts),
            np.repeat([tag for _, tag, _ in flat], counts),
            np.concatenate([mark.points for _, _, mark in flat]).astype(np.float64),
            np.concatenate([_warp(mark.points) for _, _, mark in flat]),
            np.concatenate([mark.pixels for _, _, mark in flat]).astype(np.float64),
        )


class Problem:
    """Residuals and their derivatives for `least_squares`. The unknowns are the free lens parameters, the poses of all photos
    and of the free tags, and, if `free_twists`, the twists of all tags."""

    def __init__(self, bundle: Bundle, free_lens: Bool[np.ndarray, "9"], fixed_tags: set[int], free_twists: bool):
        self.bundle = bundle
        self.free_lens = free_lens
        self.moving = np.array([tag not in fixed_tags for tag in range(len(bundle.tags))])
        self.lens_start = lens_vector(bundle.lens)
        self.first_pose = int(free_lens.sum())
        self.first_tag = self.first_pose + 6 * len(bundle.w2c)
        self.first_twist = self.first_tag + 6 * int(self.moving.sum())
        self.free_twists = free_twists
        self._twisting = len(bundle.tags) * free_twists
        self.unknowns = self.first_twist + self._twisting
        self.seen = _Seen.of(bundle.marks)
        self._last: tuple[np.ndarray, tuple[np.ndarray, csr_matrix]] | None = None
        columns = self._column_of_each_entry()
        self._there = columns >= 0
        self._columns = columns[self._there]
        self._ends = np.concatenate([[0], np.cumsum(self._there.sum(2).reshape(-1))])

    def _column_of_each_entry(self) -> Int[np.ndarray, "N 2 E"]:
        """Columns of a point's entries in the Jacobian, ascending, in the order of `_evaluate`; -1 for those of fixed tags."""
        count = len(self.seen.photo)
        first = self.first_tag + 6 * (np.cumsum(self.moving) - 1)[self.seen.tag]
        tags = np.where(self.moving[self.seen.tag][:, None], first[:, None] + np.arange(6), -1)
        columns = [
            np.tile(np.arange(self.first_pose), (count, 1)),
            self.first_pose + 6 * self.seen.photo[:, None] + np.arange(6),
            tags,
            self.first_twist + self.seen.tag[:, None][:, : int(self.free_twists)],
        ]
        return np.repeat(np.concatenate(columns, axis=1)[:, None], 2, axis=1)

    def start(self) -> Float[np.ndarray, "X"]:
        shifts = [*self.bundle.w2c[:, :3, 3], *self.bundle.tags[self.moving, :3, 3]]
        # Rotations are relative to the start: rotation vectors have a seam at half a turn.
        motions = [np.concatenate([np.zeros(3), shift]) for shift in shifts]
        return np.concatenate([self.lens_start[self.free_lens], *motions, self.bundle.twists[: self._twisting]])

    def twists_of(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "T"]:
        return x[self.first_twist :] if self.free_twists else self.bundle.twists

    def lens_of(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "9"]:
        vector = self.lens_start.copy()
        vector[self.free_lens] = x[: self.first_pose]
        return vector

    def tags_of(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "T 6"]:
        """Rotation from the start, and translation, of each tag."""
        motions = np.zeros((len(self.bundle.tags), 6))
        motions[:, 3:] = self.bundle.tags[:, :3, 3]
        motions[self.moving] = x[self.first_tag : self.first_twist].reshape(-1, 6)
        return motions

    def poses_of(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "P 6"]:
        """Rotation from the start, and translation, of each photo."""
        return x[self.first_pose : self.first_tag].reshape(-1, 6)

    def unpack(self, x: Float[np.ndarray, "X"]) -> Bundle:
        w2c = [_turned(motion, pose) for motion, pose in zip(self.poses_of(x), self.bundle.w2c, strict=True)]
        tags = [_turned(motion, pose) for motion, pose in zip(self.tags_of(x), self.bundle.tags, strict=True)]
        lens = lens_with(self.bundle.lens, self.lens_of(x))
        return replace(self.bundle, lens=lens, w2c=np.stack(w2c), tags=np.stack(tags), twists=self.twists_of(x).copy())

    def by_photo(self, residuals: Float[np.ndarray, "R"]) -> list[Float[np.ndarray, "_ 2"]]:
        ends = np.searchsorted(self.seen.photo, np.arange(1, len(self.bundle.marks)))
        return np.split(residuals.reshape(-1, 2), ends)

    def evaluate(self, x: Float[np.ndarray, "X"]) -> tuple[Float[np.ndarray, "R"], csr_matrix]:
        """Residuals, two a point, and their Jacobian."""
        # The solver asks for the two one after the other.
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = (x.copy(), self._evaluate(x))
        return self._last[1]

    def _evaluate(self, x: Float[np.ndarray, "X"]) -> tuple[Float[np.ndarray, "R"], csr_matrix]:
        seen, lens = self.seen, self.lens_of(x)
        focal, aspect = lens[0], lens[1]
        K = np.array([[focal, 0, lens[2]], [0, focal * aspect, lens[3]], [0, 0, 1]])
        tag_start, pose_start = self.bundle.tags[seen.tag, :3, :3], self.bundle.w2c[seen.photo, :3, :3]
        local = seen.points.copy()
        local[:, 2] += self.twists_of(x)[seen.tag] * seen.warp
        points, by_tag, tag_turn = _moved(self.tags_of(x), seen.tag, np.einsum("nrc,nc->nr", tag_start, local))
        there, by_pose, turn = _moved(self.poses_of(x), seen.photo, np.einsum("nrc,nc->nr", pose_start, points))
        pixels, jacobian = cv2.projectPoints(there[:, None], np.zeros(3), np.zeros(3), K, lens[4:])
        jacobian = jacobian.reshape(len(there), 2, -1)
        by_there = jacobian[:, :, 3:6]
        by_lens = np.concatenate(
            [jacobian[:, :, 6:7] + aspect * jacobian[:, :, 7:8], focal * jacobian[:, :, 7:8], jacobian[:, :, 8:15]],
            axis=2,
        )
        by_point = by_there @ turn @ pose_start
        entries = [by_lens[:, :, self.free_lens], by_there @ by_pose, by_point @ by_tag]
        if self.free_twists:
            lifted = seen.warp[:, None] * (tag_turn @ tag_start)[:, :, 2]
            entries.append(by_point @ lifted[:, :, None])
        values = np.concatenate(entries, axis=2)[self._there], self._columns, self._ends
        residuals = (pixels.reshape(-1, 2) - seen.pixels).reshape(-1)
        return residuals, csr_matrix(values, shape=(len(residuals), self.unknowns))
