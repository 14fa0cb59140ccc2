"""Bundle adjustment: lens, camera poses and tag poses together, so that all marks project to where they were seen."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.tags.detect import TagDetection
from nerf_lightning.dataset.intrinsics import Intrinsics

LENS_PARAMETERS = ("focal", "aspect", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""fx = focal, fy = focal * aspect; distortion in OpenCV's order."""
OUTLIER_SCALE_PX = 1.0
"""Beyond which a residual counts roughly linearly instead of squared."""
MAX_DENSE_UNKNOWNS = 600
"""Up to which the normal equations are solved exactly."""
COMPLEX_STEP = 1e-30
RealOrComplex = Float[np.ndarray, "..."] | Complex[np.ndarray, "..."]


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
    detections: list[dict[int, TagDetection]]
    twists: Float[np.ndarray, "T"]
    """How far the corners of each tag stand out of its plane, alternately up and down, metres: paper is seldom flat."""


@dataclass(frozen=True)
class RefinedBundle:
    """A bundle after refinement, and how well it explains the photos."""

    bundle: Bundle
    residuals: list[Float[np.ndarray, "_ 2"]]
    """Projected minus seen, pixels, by photo."""
    deviations: dict[str, float]
    """Standard deviations of the lens parameters that were free, from the normal equations and the residuals' own size."""
    bic: float
    """Bayesian information criterion (Schwarz 1978): lower is better; it charges for every parameter."""

    @property
    def rms(self) -> Float[np.ndarray, "P"]:
        """Root mean square distance in pixels, by photo."""
        return np.array([rms_length(r) for r in self.residuals])

    @property
    def total_rms(self) -> float:
        """Root mean square distance in pixels over all points."""
        return rms_length(np.concatenate(self.residuals))


def rms_length(residuals: Float[np.ndarray, "_ 2"]) -> float:
    """Root mean square length."""
    return float(np.sqrt((residuals**2).sum(1).mean()))


def lens_to_vector(lens: Intrinsics) -> Float[np.ndarray, "9"]:
    """The numbers that `LENS_PARAMETERS` names."""
    return np.array([lens.fx, lens.fy / lens.fx, lens.cx, lens.cy, *lens.opencv_distortion])


def vector_to_lens(lens: Intrinsics, vector: Float[np.ndarray, "9"]) -> Intrinsics:
    """A lens of other numbers, for photos of the same size."""
    focal, aspect, cx, cy, k1, k2, p1, p2, k3 = vector.tolist()
    return replace(
        lens, fx=focal, fy=focal * aspect, cx=cx, cy=cy, distortion=Distortion(k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)
    )


def simplify_lens(lens: Intrinsics, free: tuple[str, ...]) -> Intrinsics:
    """The lens with plain values (square pixels, centred, no distortion) for what is not free; unchanged for ()."""
    if not free:
        return lens
    plain = np.array([lens.fx, 1.0, lens.width / 2, lens.height / 2, 0, 0, 0, 0, 0])
    return vector_to_lens(lens, np.where([name in free for name in LENS_PARAMETERS], lens_to_vector(lens), plain))


def adjust_bundle(
    bundle: Bundle,
    free_lens: tuple[str, ...] = (),
    fixed_tags: frozenset[int] = frozenset({0}),
    free_twists: bool = False,
) -> RefinedBundle:
    """Minimises the reprojection error over everything that is free, with a robust loss.

    Args:
        bundle: where to start; every photo holds at least one mark.
        free_lens: names out of `LENS_PARAMETERS`; the others keep their value.
        fixed_tags: numbers of the tags that do not move: at least one, which holds the world in place.
        free_twists: whether tags may be twisted.
    """
    problem = BundleProblem(bundle, free_lens, fixed_tags, free_twists)
    start = problem.start[problem.free]
    dense = len(start) <= MAX_DENSE_UNKNOWNS
    solution = least_squares(
        problem.residuals,
        start,
        lambda x: problem.jacobian(x).toarray() if dense else problem.jacobian(x),
        method="trf",
        loss="soft_l1",  # Huber's, smoothed: at its kink the solver gets stuck
        f_scale=OUTLIER_SCALE_PX,
        x_scale="jac",
        tr_solver="exact" if dense else "lsmr",
        max_nfev=100,
    )
    flat = problem.residuals(solution.x)
    # Outliers must not pass for noise: the spread is that of the middle of the distribution.
    sigma = max(1.4826 * float(np.median(np.abs(flat))), 1e-6)
    deviations = {}
    if free_lens:
        slopes = problem.jacobian(solution.x)
        variances = np.diag(np.linalg.pinv((slopes.T @ slopes).toarray(), hermitian=True)) * sigma**2
        names = [name for name in LENS_PARAMETERS if name in free_lens]
        deviations = {name: float(np.sqrt(max(v, 0.0))) for name, v in zip(names, variances, strict=False)}
    cost = 2 * float(solution.cost)  # the robust one, so that an outlier does not buy parameters
    bic = len(flat) * np.log(max(cost / len(flat), 1e-12)) + len(start) * np.log(len(flat))
    ends = np.cumsum([sum(len(detection.pixels) for detection in photo.values()) for photo in bundle.detections])
    by_photo = np.split(flat.reshape(-1, 2), ends[:-1])
    return RefinedBundle(problem.to_bundle(solution.x), by_photo, deviations, float(bic))


class BundleProblem:
    """Residuals and their derivatives for `least_squares`.

    All numbers stand in one vector: the lens, six of each photo, six of each tag, and the tags' twists. Six numbers of a pose
    are its rotation from the start, see `rotate_points`, and its translation. `free` says which are unknown; others keep their
    value in `start`.
    """

    def __init__(self, bundle: Bundle, free_lens: tuple[str, ...], fixed_tags: frozenset[int], free_twists: bool):
        self.bundle = bundle
        first_tag = 9 + 6 * len(bundle.w2c)
        first_twist = first_tag + 6 * len(bundle.tags)
        self.ends = [9, first_tag, first_twist]
        poses = np.pad(np.concatenate([bundle.w2c, bundle.tags])[:, :3, 3], ((0, 0), (3, 0)))
        self.start = np.concatenate([lens_to_vector(bundle.lens), poses.reshape(-1), bundle.twists])
        self.free = np.ones(len(self.start), bool)
        self.free[:9] = [name in free_lens for name in LENS_PARAMETERS]
        self.free[first_tag:first_twist] = np.repeat([tag not in fixed_tags for tag in range(len(bundle.tags))], 6)
        self.free[first_twist:] = free_twists
        seen = [
            (photo, tag, detection)
            for photo, detections in enumerate(bundle.detections)
            for tag, detection in detections.items()
        ]
        counts = [len(detection.pixels) for _, _, detection in seen]
        photo, tag = (np.repeat([entry[i] for entry in seen], counts) for i in (0, 1))
        self.columns = np.column_stack(
            [
                np.tile(np.arange(9), (len(photo), 1)),
                9 + 6 * photo[:, None] + np.arange(6),
                first_tag + 6 * tag[:, None] + np.arange(6),
                first_twist + tag,
            ]
        )
        """Of the 22 numbers that each point depends on, in the vector of all."""
        self.pixels = np.concatenate([detection.pixels for _, _, detection in seen])
        self.points = np.concatenate([detection.points for _, _, detection in seen])
        self.twist_directions = np.concatenate([_twist_direction(detection.points) for _, _, detection in seen])
        self.photo_rotations, self.tag_rotations = bundle.w2c[photo, :3, :3], bundle.tags[tag, :3, :3]

    def vector(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "V"]:
        """All numbers, from the unknown ones."""
        vector = self.start.copy()
        vector[self.free] = x
        return vector

    def residuals(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "R"]:
        """Projected minus seen, two a point, pixels."""
        return (self.project(self.vector(x)[self.columns]) - self.pixels).reshape(-1)

    def jacobian(self, x: Float[np.ndarray, "X"]) -> csr_matrix:
        """Derivatives of the residuals, exact, by a complex step (Squire and Trapp 1998)."""
        which = np.flatnonzero(self.free[self.columns].any(0))
        steps = 1j * COMPLEX_STEP * np.eye(self.columns.shape[1])[which, None]
        slopes = self.project(self.vector(x)[self.columns] + steps).imag / COMPLEX_STEP
        values = np.moveaxis(slopes, 0, -1).reshape(-1, len(which))
        columns = np.repeat(self.columns[:, which], 2, axis=0)
        ends = np.arange(len(values) + 1) * values.shape[1]
        every = csr_matrix((values.reshape(-1), columns.reshape(-1), ends), shape=(len(values), len(self.start)))
        return every[:, self.free]

    def project(self, numbers: RealOrComplex) -> RealOrComplex:
        """Pixels of all points, each given the numbers that it depends on: (..., N, 22) to (..., N, 2)."""
        lens, photo, tag, twist = np.split(numbers, [9, 15, 21], axis=-1)
        local = self.points + twist * self.twist_directions
        world = rotate_points(tag[..., :3], np.einsum("nrc,...nc->...nr", self.tag_rotations, local)) + tag[..., 3:]
        camera_points = (
            rotate_points(photo[..., :3], np.einsum("nrc,...nc->...nr", self.photo_rotations, world)) + photo[..., 3:]
        )
        focal, aspect, cx, cy, k1, k2, p1, p2, k3 = np.moveaxis(lens, -1, 0)
        x, y = camera_points[..., 0] / camera_points[..., 2], camera_points[..., 1] / camera_points[..., 2]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        column = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        row = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([focal * column + cx, focal * aspect * row + cy], axis=-1)

    def to_bundle(self, x: Float[np.ndarray, "X"]) -> Bundle:
        """The bundle that the unknowns stand for."""
        lens, photos, tags, twists = np.split(self.vector(x), self.ends)
        w2c = _rotate_poses(photos.reshape(-1, 6), self.bundle.w2c)
        moved = _rotate_poses(tags.reshape(-1, 6), self.bundle.tags)
        return replace(self.bundle, lens=vector_to_lens(self.bundle.lens, lens), w2c=w2c, tags=moved, twists=twists)


def rotate_points(vectors: RealOrComplex, points: RealOrComplex) -> RealOrComplex:
    """Points turned by quaternions proportional to (v / 2, 1): near 0, v is a rotation vector, and all is smooth there."""
    half = vectors / 2
    across = np.cross(half, points)
    return points + 2 * (across + np.cross(half, across)) / (1 + (half * half).sum(-1, keepdims=True))


def _rotate_poses(numbers: Float[np.ndarray, "P 6"], poses: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P 4 4"]:
    """Poses turned further as `rotate_points` does, at their new places."""
    quaternions = np.pad(numbers[:, :3] / 2, ((0, 0), (0, 1)), constant_values=1.0)
    out = poses.copy()
    out[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix() @ poses[:, :3, :3]
    out[:, :3, 3] = numbers[:, 3:]
    return out


def _twist_direction(points: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M 3"]:
    """Where a twist by 1 moves each point: up by x y, 1 at the corners. Only this bend of a square lifts its corners out of
    their common plane."""
    extent = np.abs(points[:, :2]).max(0)
    return np.pad((points[:, :1] * points[:, 1:2]) / extent.prod(), ((0, 0), (2, 0)))
