"""Bundle adjustment: lens, camera poses and tag poses together, so that all marks project to where they were seen."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from nerf_lightning.capture.detect import Mark
from nerf_lightning.capture.geometry import to_matrix
from nerf_lightning.dataset.lens import Lens

LENS_PARAMETERS = ("focal", "aspect", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""fx = focal, fy = focal * aspect; distortion in OpenCV's order."""
OUTLIER = 1.0
"""Pixels beyond which a residual counts about linearly instead of squared."""
DENSE = 600
"""Unknowns up to which the normal equations are solved exactly."""


@dataclass(frozen=True)
class Bundle:
    """All unknowns, and what was seen.

    Photos and tags are numbered; `marks[p]` maps a tag's number to its mark in photo p.
    """

    lens: Lens
    w2c: Float[np.ndarray, "P 4 4"]
    """World to camera, by photo."""
    tags: Float[np.ndarray, "T 4 4"]
    """Tag to world, by tag."""
    marks: list[dict[int, Mark]]
    twists: Float[np.ndarray, "T"]
    """How far the corners of each tag stand out of its plane, in turn up and down, metres: paper is seldom flat."""


@dataclass(frozen=True)
class Refined:
    """A bundle after refinement, and how well it explains the photos."""

    bundle: Bundle
    residuals: list[Float[np.ndarray, "_ 2"]]
    """Projected minus seen, pixels, by photo."""
    deviations: dict[str, float]
    """Standard deviations of the lens parameters that were free, from the normal equations and the residuals' own size."""
    bic: float
    """Bayesian information criterion: lower is better, more parameters must pay for themselves."""

    @property
    def rms(self) -> Float[np.ndarray, "P"]:
        """Root mean square distance in pixels, by photo."""
        return np.array([np.sqrt((r**2).sum(1).mean()) if len(r) else 0.0 for r in self.residuals])

    def mark_rms(self, photo: int) -> dict[int, float]:
        """Root mean square distance in pixels of each mark of a photo, by the tag's number."""
        marks = self.bundle.marks[photo]
        ends = np.cumsum([len(mark.pixels) for mark in marks.values()])[:-1]
        parts = zip(marks, np.split(self.residuals[photo], ends), strict=True)
        return {tag: float(np.sqrt((part**2).sum(1).mean())) for tag, part in parts}

    @property
    def total_rms(self) -> float:
        """Root mean square distance in pixels over all points."""
        return float(np.sqrt((np.concatenate(self.residuals) ** 2).sum(1).mean()))


def lens_vector(lens: Lens) -> Float[np.ndarray, "9"]:
    return np.array([lens.fx, lens.fy / lens.fx, lens.cx, lens.cy, *lens.distortion])


def lens_with(lens: Lens, vector: Float[np.ndarray, "9"]) -> Lens:
    focal, aspect, cx, cy, *distortion = (float(v) for v in vector)
    k1, k2, p1, p2, k3 = distortion
    return replace(lens, fx=focal, fy=focal * aspect, cx=cx, cy=cy, distortion=(k1, k2, p1, p2, k3))


def simplified(lens: Lens, free: tuple[str, ...]) -> Lens:
    """The lens with plain values (square pixels, centred, no distortion) where a model sets nothing free; as it is for ()."""
    if not free:
        return lens
    plain = np.array([lens.fx, 1.0, lens.width / 2, lens.height / 2, 0, 0, 0, 0, 0])
    kept = np.array([name in free for name in LENS_PARAMETERS])
    return lens_with(lens, np.where(kept, lens_vector(lens), plain))


def _warp(points: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M"]:
    """How high a twist by 1 lifts each point: x y, 1 at the corners. Of all ways to bend a square, only this one lifts its
    corners out of their common plane."""
    extent = np.abs(points[:, :2]).max(0)
    return points[:, 0] * points[:, 1] / (extent[0] * extent[1])


def _moved(
    vector: Float[np.ndarray, "6"], points: Float[np.ndarray, "M 3"]
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3 6"]]:
    """Points carried along by a motion, and their derivatives with respect to its six numbers."""
    matrix, derivative = cv2.Rodrigues(vector[:3])
    # OpenCV 4 and 5 give the derivative of the nine entries in rows or in columns of three.
    turn = derivative.reshape(3, 3, 3) if derivative.shape == (3, 9) else derivative.T.reshape(3, 3, 3)
    jacobian = np.empty((len(points), 3, 6))
    jacobian[:, :, :3] = np.einsum("krc,nc->nrk", turn, points)
    jacobian[:, :, 3:] = np.eye(3)
    return points @ matrix.T + vector[3:], jacobian


def _turned(motion: Float[np.ndarray, "6"], pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """A pose turned further, at its new place."""
    out = to_matrix(motion)
    out[:3, :3] = out[:3, :3] @ pose[:3, :3]
    return out


class _Problem:
    """Residuals and their derivatives for `least_squares`: unknowns are the free lens parameters, all photos, the free tags,
    and all tags' twists where they are free."""

    def __init__(self, bundle: Bundle, free_lens: Bool[np.ndarray, "9"], fixed_tags: set[int], free_twists: bool):
        self.bundle = bundle
        self.free_lens = free_lens
        self.moving = [tag for tag in range(len(bundle.tags)) if tag not in fixed_tags]
        self.lens_start = lens_vector(bundle.lens)
        self.first_pose = int(free_lens.sum())
        self.first_tag = self.first_pose + 6 * len(bundle.w2c)
        self.first_twist = self.first_tag + 6 * len(self.moving)
        self.free_twists = free_twists
        self._last: tuple[np.ndarray, tuple[list[np.ndarray], csr_matrix]] | None = None
        self.unknowns = self.first_twist + self._twisting
        self.column = {tag: self.first_tag + 6 * i for i, tag in enumerate(self.moving)}

    def start(self) -> Float[np.ndarray, "X"]:
        shifts = [*self.bundle.w2c[:, :3, 3], *(self.bundle.tags[tag][:3, 3] for tag in self.moving)]
        # Turns are told from where they start: a rotation vector as such has a seam at half a turn.
        motions = [np.concatenate([np.zeros(3), shift]) for shift in shifts]
        return np.concatenate([self.lens_start[self.free_lens], *motions, self.bundle.twists[: self._twisting]])

    @property
    def _twisting(self) -> int:
        return len(self.bundle.tags) * self.free_twists

    def twists_of(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "T"]:
        return x[self.first_twist :] if self.free_twists else self.bundle.twists

    def lens_of(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "9"]:
        vector = self.lens_start.copy()
        vector[self.free_lens] = x[: self.first_pose]
        return vector

    def tag_of(self, x: Float[np.ndarray, "X"], tag: int) -> Float[np.ndarray, "6"]:
        """Further turn and whole shift of a tag."""
        still = np.concatenate([np.zeros(3), self.bundle.tags[tag][:3, 3]])
        return x[self.column[tag] : self.column[tag] + 6] if tag in self.column else still

    def pose_of(self, x: Float[np.ndarray, "X"], photo: int) -> Float[np.ndarray, "6"]:
        """Further turn and whole shift of a photo."""
        return x[self.first_pose + 6 * photo : self.first_pose + 6 * photo + 6]

    def unpack(self, x: Float[np.ndarray, "X"]) -> Bundle:
        w2c = np.stack([_turned(self.pose_of(x, p), pose) for p, pose in enumerate(self.bundle.w2c)])
        tags = [_turned(self.tag_of(x, tag), pose) for tag, pose in enumerate(self.bundle.tags)]
        lens = lens_with(self.bundle.lens, self.lens_of(x))
        return replace(self.bundle, lens=lens, w2c=w2c, tags=np.stack(tags), twists=self.twists_of(x).copy())

    def evaluate(self, x: Float[np.ndarray, "X"]) -> tuple[list[np.ndarray], csr_matrix]:
        """Residuals a photo, [2 M] each, and the Jacobian of all."""
        # The solver asks for both, one after the other.
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = (x.copy(), self._evaluate(x))
        return self._last[1]

    def _evaluate(self, x: Float[np.ndarray, "X"]) -> tuple[list[np.ndarray], csr_matrix]:
        lens = self.lens_of(x)
        focal, aspect = lens[0], lens[1]
        twists = self.twists_of(x)
        K = np.array([[focal, 0, lens[2]], [0, focal * aspect, lens[3]], [0, 0, 1]])
        residuals, rows, columns, values, row = [], [], [], [], 0

        def put(block: np.ndarray, first: int) -> None:
            height, width = block.shape
            rows.append(np.repeat(np.arange(row, row + height), width))
            columns.append(np.tile(np.arange(first, first + width), height))
            values.append(block.reshape(-1))

        for photo, marks in enumerate(self.bundle.marks):
            pose, start, parts = self.pose_of(x, photo), self.bundle.w2c[photo][:3, :3], []
            to_camera = cv2.Rodrigues(pose[:3])[0] @ start
            for tag, mark in marks.items():
                warp = _warp(mark.points)
                local = mark.points + twists[tag] * warp[:, None] * [0, 0, 1]
                motion, tag_start = self.tag_of(x, tag), self.bundle.tags[tag][:3, :3]
                points, by_tag = _moved(motion, local @ tag_start.T)
                seen, by_pose = _moved(pose, points @ start.T)
                pixels, jacobian = cv2.projectPoints(seen[:, None], np.zeros(3), np.zeros(3), K, lens[4:])
                parts.append((pixels.reshape(-1, 2) - mark.pixels).reshape(-1))
                by_seen = jacobian[:, 3:6].reshape(-1, 2, 3)
                put((by_seen @ by_pose).reshape(-1, 6), self.first_pose + 6 * photo)
                if self.first_pose:
                    by_lens = np.empty((len(jacobian), 9))
                    by_lens[:, 0] = jacobian[:, 6] + aspect * jacobian[:, 7]
                    by_lens[:, 1] = focal * jacobian[:, 7]
                    by_lens[:, 2:] = jacobian[:, 8:15]
                    put(by_lens[:, self.free_lens], 0)
                by_point = by_seen @ to_camera
                if self.free_twists:
                    normal = cv2.Rodrigues(motion[:3])[0] @ tag_start[:, 2]
                    put((by_point @ normal * warp[:, None]).reshape(-1, 1), self.first_twist + tag)
                if tag in self.column:
                    put((by_point @ by_tag).reshape(-1, 6), self.column[tag])
                row += len(jacobian)
            residuals.append(np.concatenate(parts) if parts else np.zeros(0))
        places = np.concatenate(rows), np.concatenate(columns)
        return residuals, csr_matrix((np.concatenate(values), places), shape=(row, self.unknowns))


def refine(
    bundle: Bundle,
    free_lens: tuple[str, ...] = (),
    fixed_tags: frozenset[int] = frozenset({0}),
    free_twists: bool = False,
) -> Refined:
    """Minimises the reprojection error over everything that is free, robustly.

    Args:
        bundle: where to start; every photo holds at least one mark.
        free_lens: names out of `LENS_PARAMETERS`; the others keep their value.
        fixed_tags: numbers of the tags that do not move: at least one, which holds the world in place.
        free_twists: whether tags may be twisted.
    """
    free = np.array([name in free_lens for name in LENS_PARAMETERS])
    problem = _Problem(bundle, free, set(fixed_tags), free_twists)
    dense = problem.unknowns <= DENSE

    def jacobian(x: np.ndarray) -> np.ndarray | csr_matrix:
        sparse = problem.evaluate(x)[1]
        return sparse.toarray() if dense else sparse

    solution = least_squares(
        lambda x: np.concatenate(problem.evaluate(x)[0]),
        problem.start(),
        jacobian,
        method="trf",
        loss="soft_l1",  # Huber's, smoothed: at its kink the solver gets stuck
        f_scale=OUTLIER,
        x_scale="jac",
        tr_solver="exact" if dense else "lsmr",
        max_nfev=100,
    )
    residuals, slopes = problem.evaluate(solution.x)
    flat = np.concatenate(residuals)
    # Outliers must not pass for noise: the spread is that of the middle of the distribution.
    sigma = max(1.4826 * float(np.median(np.abs(flat))), 1e-6)
    deviations = {}
    if free.any():
        normal = (slopes.T @ slopes).toarray()
        covariance = np.linalg.pinv(normal, hermitian=True) * sigma**2
        names = [name for name, chosen in zip(LENS_PARAMETERS, free, strict=True) if chosen]
        deviations = {name: float(np.sqrt(max(covariance[i, i], 0.0))) for i, name in enumerate(names)}
    cost = 2 * float(solution.cost)  # the robust one, so that an outlier does not buy parameters
    bic = len(flat) * np.log(max(cost / len(flat), 1e-12)) + problem.unknowns * np.log(len(flat))
    return Refined(problem.unpack(solution.x), [r.reshape(-1, 2) for r in residuals], deviations, float(bic))
