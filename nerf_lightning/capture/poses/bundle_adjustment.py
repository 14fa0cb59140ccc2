"""Bundle adjustment of lens, camera poses and tag poses, by the reprojection error of all detections."""

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
"""fx = focal, fy = focal * aspect; distortion coefficients in OpenCV's order."""
OUTLIER_SCALE_PX = 1.0
"""Residual beyond which the robust loss is roughly linear instead of quadratic."""
MAX_DENSE_UNKNOWNS = 600
"""Most unknowns for which the normal equations are solved exactly."""
COMPLEX_STEP = 1e-30
RealOrComplex = Float[np.ndarray, "..."] | Complex[np.ndarray, "..."]


@dataclass(frozen=True)
class Bundle:
    """All unknowns and detections of a bundle adjustment; `detections[p]` maps tag indices to detections in photo p."""

    lens: Intrinsics
    w2c: Float[np.ndarray, "P 4 4"]
    """World to camera, one per photo."""
    tags: Float[np.ndarray, "T 4 4"]
    """Tag to world."""
    detections: list[dict[int, TagDetection]]
    twists: Float[np.ndarray, "T"]
    """Height of each tag's corners above its plane, alternately up and down, meters: paper is seldom flat."""


@dataclass(frozen=True)
class RefinedBundle:
    """A bundle after adjustment, with residuals and uncertainty."""

    bundle: Bundle
    residuals: list[Float[np.ndarray, "_ 2"]]
    """Residuals (projected - detected), pixels, one array per photo."""
    deviations: dict[str, float]
    """Standard deviations of the free lens parameters, from the normal equations and the residuals."""
    bic: float
    """Bayesian information criterion (Schwarz 1978), lower is better; it penalizes every parameter."""

    @property
    def rms(self) -> Float[np.ndarray, "P"]:
        """RMS reprojection error of each photo, pixels."""
        return np.array([rms_length(r) for r in self.residuals])

    @property
    def total_rms(self) -> float:
        """RMS reprojection error over all points, pixels."""
        return rms_length(np.concatenate(self.residuals))


def rms_length(residuals: Float[np.ndarray, "_ 2"]) -> float:
    return float(np.sqrt((residuals**2).sum(1).mean()))


def lens_to_vector(lens: Intrinsics) -> Float[np.ndarray, "9"]:
    """Lens parameters in the order of `LENS_PARAMETERS`."""
    return np.array([lens.fx, lens.fy / lens.fx, lens.cx, lens.cy, *lens.opencv_distortion])


def vector_to_lens(lens: Intrinsics, vector: Float[np.ndarray, "9"]) -> Intrinsics:
    """Inverse of `lens_to_vector`; the image size is that of `lens`."""
    focal, aspect, cx, cy, k1, k2, p1, p2, k3 = vector.tolist()
    return replace(lens, fx=focal, fy=focal * aspect, cx=cx, cy=cy, distortion=Distortion(k1, k2, k3, p1=p1, p2=p2))


def simplify_lens(lens: Intrinsics, free: tuple[str, ...]) -> Intrinsics:
    """Resets parameters that are not free (square pixels, centered, no distortion); unchanged for ()."""
    if not free:
        return lens
    defaults = np.array([lens.fx, 1.0, lens.width / 2, lens.height / 2, 0, 0, 0, 0, 0])
    return vector_to_lens(lens, np.where([name in free for name in LENS_PARAMETERS], lens_to_vector(lens), defaults))


def adjust_bundle(
    bundle: Bundle,
    free_lens: tuple[str, ...] = (),
    fixed_tags: frozenset[int] = frozenset({0}),
    free_twists: bool = False,
) -> RefinedBundle:
    """Minimizes the reprojection error over all free parameters, with a robust loss.

    Args:
        bundle: initial values; every photo has at least one detection.
        free_lens: free parameters out of `LENS_PARAMETERS`.
        fixed_tags: indices of fixed tags: at least one, which fixes the gauge.
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
    # The median absolute deviation: outliers must not count as noise.
    sigma = max(1.4826 * float(np.median(np.abs(flat))), 1e-6)
    deviations = {}
    if free_lens:
        jacobian = problem.jacobian(solution.x)
        variances = np.diag(np.linalg.pinv((jacobian.T @ jacobian).toarray(), hermitian=True)) * sigma**2
        names = [name for name in LENS_PARAMETERS if name in free_lens]
        deviations = {name: float(np.sqrt(max(v, 0.0))) for name, v in zip(names, variances, strict=False)}
    cost = 2 * float(solution.cost)  # the robust cost, so that outliers do not justify parameters
    bic = len(flat) * np.log(max(cost / len(flat), 1e-12)) + len(start) * np.log(len(flat))
    ends = np.cumsum([sum(len(detection.pixels) for detection in photo.values()) for photo in bundle.detections])
    by_photo = np.split(flat.reshape(-1, 2), ends[:-1])
    return RefinedBundle(problem.to_bundle(solution.x), by_photo, deviations, float(bic))


class BundleProblem:
    """Residuals and their Jacobian for `least_squares`.

    The parameter vector holds the lens, six numbers per photo, six per tag, and the tags' twists. A pose's six numbers are
    its rotation relative to the start, see `rotate_points`, and its translation. `free` masks the unknowns; the others keep
    their value in `start`.
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
        by_photo = enumerate(bundle.detections)
        detections = [(photo, tag, corners) for photo, tags in by_photo for tag, corners in tags.items()]
        counts = [len(detection.pixels) for _, _, detection in detections]
        photo, tag = (np.repeat([entry[i] for entry in detections], counts) for i in (0, 1))
        lens_columns = np.tile(np.arange(9), (len(photo), 1))
        photo_columns, tag_columns = 9 + 6 * photo[:, None] + np.arange(6), first_tag + 6 * tag[:, None] + np.arange(6)
        self.columns = np.column_stack([lens_columns, photo_columns, tag_columns, first_twist + tag])
        """Indices [N, 22] of the parameters that each point depends on."""
        self.pixels = np.concatenate([detection.pixels for _, _, detection in detections])
        self.points = np.concatenate([detection.points for _, _, detection in detections])
        self.twist_directions = np.concatenate([_twist_direction(detection.points) for _, _, detection in detections])
        self.photo_rotations, self.tag_rotations = bundle.w2c[photo, :3, :3], bundle.tags[tag, :3, :3]

    def vector(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "V"]:
        """Full parameter vector from the unknowns."""
        vector = self.start.copy()
        vector[self.free] = x
        return vector

    def residuals(self, x: Float[np.ndarray, "X"]) -> Float[np.ndarray, "R"]:
        """Residuals (projected - detected), pixels, two per point."""
        return (self.project(self.vector(x)[self.columns]) - self.pixels).reshape(-1)

    def jacobian(self, x: Float[np.ndarray, "X"]) -> csr_matrix:
        """Exact Jacobian of the residuals, by complex steps (Squire and Trapp 1998)."""
        free_columns = np.flatnonzero(self.free[self.columns].any(0))
        steps = 1j * COMPLEX_STEP * np.eye(self.columns.shape[1])[free_columns, None]
        derivatives = self.project(self.vector(x)[self.columns] + steps).imag / COMPLEX_STEP
        values = np.moveaxis(derivatives, 0, -1).reshape(-1, len(free_columns))
        columns = np.repeat(self.columns[:, free_columns], 2, axis=0)
        ends = np.arange(len(values) + 1) * values.shape[1]
        full = csr_matrix((values.reshape(-1), columns.reshape(-1), ends), shape=(len(values), len(self.start)))
        return full[:, self.free]

    def project(self, parameters: RealOrComplex) -> RealOrComplex:
        """Projects all points, given the parameters of each: (..., N, 22) to pixels (..., N, 2)."""
        lens, photo, tag, twist = np.split(parameters, [9, 15, 21], axis=-1)
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
        """Bundle with the given unknowns."""
        lens, photos, tags, twists = np.split(self.vector(x), self.ends)
        w2c = _rotate_poses(photos.reshape(-1, 6), self.bundle.w2c)
        tag_poses = _rotate_poses(tags.reshape(-1, 6), self.bundle.tags)
        return replace(self.bundle, lens=vector_to_lens(self.bundle.lens, lens), w2c=w2c, tags=tag_poses, twists=twists)


def rotate_points(vectors: RealOrComplex, points: RealOrComplex) -> RealOrComplex:
    """Rotates points by quaternions proportional to (v / 2, 1): near 0, v is a rotation vector, and the map is smooth."""
    half = vectors / 2
    across = np.cross(half, points)
    return points + 2 * (across + np.cross(half, across)) / (1 + (half * half).sum(-1, keepdims=True))


def _rotate_poses(vectors: Float[np.ndarray, "P 6"], poses: Float[np.ndarray, "P 4 4"]) -> Float[np.ndarray, "P 4 4"]:
    """Rotates poses as `rotate_points` does and sets their translations."""
    quaternions = np.pad(vectors[:, :3] / 2, ((0, 0), (0, 1)), constant_values=1.0)
    out = poses.copy()
    out[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix() @ poses[:, :3, :3]
    out[:, :3, 3] = vectors[:, 3:]
    return out


def _twist_direction(points: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M 3"]:
    """Displacement of each point by a unit twist: up by x y, which is 1 at the corners; no other bend of a square moves
    its corners out of their plane."""
    extent = np.abs(points[:, :2]).max(0)
    return np.pad((points[:, :1] * points[:, 1:2]) / extent.prod(), ((0, 0), (2, 0)))
