"""Bundle adjustment: lens, camera poses and tag poses together, so that all marks project to where they were seen."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from nerf_lightning.capture.poses.bundle import LENS_PARAMETERS, Bundle, Problem

OUTLIER = 1.0
"""Pixels beyond which a residual counts roughly linearly instead of squared."""
DENSE = 600
"""Unknowns up to which the normal equations are solved exactly."""


def rms_length(residuals: Float[np.ndarray, "_ 2"]) -> float:
    """Root mean square length."""
    return float(np.sqrt((residuals**2).sum(1).mean()))


@dataclass(frozen=True)
class Refined:
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

    def by_mark(self, photo: int) -> dict[int, Float[np.ndarray, "_ 2"]]:
        """Residuals of a photo by the tag's number."""
        marks = self.bundle.marks[photo]
        ends = np.cumsum([len(mark.pixels) for mark in marks.values()])[:-1]
        return dict(zip(marks, np.split(self.residuals[photo], ends), strict=True))

    @property
    def total_rms(self) -> float:
        """Root mean square distance in pixels over all points."""
        return rms_length(np.concatenate(self.residuals))


def refine(
    bundle: Bundle,
    free_lens: tuple[str, ...] = (),
    fixed_tags: frozenset[int] = frozenset({0}),
    free_twists: bool = False,
) -> Refined:
    """Minimises the reprojection error over everything that is free, with a robust loss.

    Args:
        bundle: where to start; every photo holds at least one mark.
        free_lens: names out of `LENS_PARAMETERS`; the others keep their value.
        fixed_tags: numbers of the tags that do not move: at least one, which holds the world in place.
        free_twists: whether tags may be twisted.
    """
    free = np.array([name in free_lens for name in LENS_PARAMETERS])
    problem = Problem(bundle, free, set(fixed_tags), free_twists)
    dense = problem.unknowns <= DENSE

    def jacobian(x: np.ndarray) -> np.ndarray | csr_matrix:
        sparse = problem.evaluate(x)[1]
        return sparse.toarray() if dense else sparse

    solution = least_squares(
        lambda x: problem.evaluate(x)[0],
        problem.start(),
        jacobian,
        method="trf",
        loss="soft_l1",  # Huber's, smoothed: at its kink the solver gets stuck
        f_scale=OUTLIER,
        x_scale="jac",
        tr_solver="exact" if dense else "lsmr",
        max_nfev=100,
    )
    flat, slopes = problem.evaluate(solution.x)
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
    return Refined(problem.unpack(solution.x), problem.by_photo(flat), deviations, float(bic))
