"""A Gaussian process over photos taken one after the other: what neighbours say about each."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

WINDOW = 64
"""Photos that are looked at together; the middle half of each window counts."""
ANYWHERE = 1.0
"""Variance of the middle of the walk, radians^2: nothing is known about it."""
KINDS = (np.inf, 2.5, 1.5)
"""How many derivatives a walk may have, plus 1/2: Matern's family of covariances."""
SHORTEST = 0.2
"""Reach at which neighbours say nothing of each other."""


@dataclass(frozen=True)
class Walk:
    """How a photographer moves: the covariance of two photos' coordinates by how far apart they were taken."""

    spread: float
    """Standard deviation about the middle of the walk."""
    reach: float
    """Photos over which it forgets where it came from."""
    kind: float

    def covariance(self, lag: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """Rasmussen and Williams 2006, "Gaussian processes for machine learning", equations 4.9 and 4.17."""
        r = np.abs(lag) / self.reach
        if self.kind == np.inf:
            shape = np.exp(-(r**2) / 2)
        elif self.kind == 2.5:
            shape = (1 + np.sqrt(5) * r + 5 * r**2 / 3) * np.exp(-np.sqrt(5) * r)
        else:
            shape = (1 + np.sqrt(3) * r) * np.exp(-np.sqrt(3) * r)
        return self.spread**2 * shape + ANYWHERE

    def near(self, factor: float) -> list["Walk"]:
        """Itself, and walks that are a little wider, narrower, slower or quicker."""
        steps = [(1, 1), (factor, 1), (1 / factor, 1), (1, factor), (1, 1 / factor), (factor, factor)]
        changed = [(self.spread * a, max(self.reach * b, SHORTEST)) for a, b in [*steps, (1 / factor, 1 / factor)]]
        return [replace(self, spread=spread, reach=reach) for spread, reach in changed]


@dataclass(frozen=True)
class Windows:
    """Photos in overlapping windows, so that the effort grows only with their number."""

    rows: Int[np.ndarray, "B W"]
    core: Bool[np.ndarray, "B W"]
    """Each photo is in the core of one window."""

    @classmethod
    def of(cls, count: int) -> "Windows":
        width = min(WINDOW, count)
        starts = [*range(0, count - width, WINDOW // 2), count - width]
        rows = np.array(starts)[:, None] + np.arange(width)
        ends = np.array([0, *(start + WINDOW // 4 for start in starts[1:]), count])
        return cls(rows, (rows >= ends[:-1, None]) & (rows < ends[1:, None]))

    def marginals(
        self, walk: Walk, precision: Float[np.ndarray, "N 2 2"], pull: Float[np.ndarray, "N 2"]
    ) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2 2"]]:
        """Mean and covariance of each photo's two coordinates, given what all photos say: exp(-x P x / 2 + p x) each."""
        K, root, inner, _ = self._inner(walk, precision, pull)
        windows, width = self.rows.shape
        half = np.einsum("biac,bij->biajc", root, K).reshape(windows, 2 * width, 2 * width)
        full = np.einsum("bij,ac->biajc", K, np.eye(2)).reshape(half.shape) - half.transpose(0, 2, 1) @ np.linalg.solve(
            inner, half
        )
        means = (full @ pull[self.rows].reshape(windows, -1, 1)).reshape(windows, width, 2)
        blocks = full.reshape(windows, width, 2, width, 2)[:, np.arange(width), :, np.arange(width)].swapaxes(0, 1)
        mean, covariance = np.empty_like(pull), np.empty_like(precision)
        mean[self.rows[self.core]], covariance[self.rows[self.core]] = means[self.core], blocks[self.core]
        return mean, covariance

    def evidence(
        self, walk: Walk, precision: Float[np.ndarray, "N 2 2"], pull: Float[np.ndarray, "N 2"], each: bool = False
    ) -> float:
        """Logarithm of the integral of the walk's density times what the photos say.

        Args:
            each: counts every photo once, by taking cores alone; else whole windows, which tells walks apart better.
        """
        _, _, inner, g = self._inner(walk, precision, pull, self.core if each else None)
        factor = np.linalg.cholesky(inner)
        log_determinants = 2 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum()
        return float((g * (g - np.linalg.solve(inner, g))).sum() - log_determinants) / 2

    def _inner(
        self,
        walk: Walk,
        precision: Float[np.ndarray, "N 2 2"],
        pull: Float[np.ndarray, "N 2"],
        only: Bool[np.ndarray, "B W"] | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """K, the roots R of the precisions, I + R K R, and R^-1 times the pulls: well conditioned however smooth the walk."""
        windows, width = self.rows.shape
        values, vectors = np.linalg.eigh(precision)
        scale = np.sqrt(values)
        root = ((vectors * scale[:, None]) @ vectors.swapaxes(1, 2))[self.rows]
        g = np.einsum("nij,nj,nkj,nk->ni", vectors, 1 / scale, vectors, pull)[self.rows]
        if only is not None:
            root, g = root * only[..., None, None], g * only[..., None]
        K = walk.covariance((self.rows[:, :, None] - self.rows[:, None]).astype(np.float64))
        inner = np.einsum("bij,biac,bjcd->biajd", K, root, root).reshape(windows, 2 * width, 2 * width)
        return K, root, inner + np.eye(2 * width), g.reshape(windows, 2 * width, 1)
