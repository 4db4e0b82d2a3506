"""Residuals against the noise that observations state: over all, by camera and by image."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.solve._problem import Problem

__all__ = ["Residuals"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """Sums of squared whitened residuals of the observations in use, and what noise alone would give."""

    image: IntArray
    """(n,) row of the image of each observation."""
    square: FloatArray
    """(n,) squared length of each residual."""
    expected: FloatArray
    """(n,) its expectation: 2 less an even share of the three numbers of its landmark."""

    @staticmethod
    def of(problem: Problem) -> "Residuals":
        """Residuals of a problem at its values."""
        m, rows = problem.measurements, np.flatnonzero(problem.kept)
        whitened, _ = problem.residuals()
        views = np.bincount(m.landmark[rows], minlength=m.n_landmarks)
        return Residuals(
            image=m.image[rows],
            square=np.sum(whitened[rows] ** 2, axis=1),
            expected=2 - 3 / views[m.landmark[rows]],
        )

    @property
    def n_not_finite(self) -> int:
        """Number of residuals that are no numbers."""
        return int(np.count_nonzero(~np.isfinite(self.square)))

    @property
    def ratio(self) -> float:
        """RMS residual over what the stated noise would make it."""
        return float(np.sqrt(self.square.sum() / max(self.expected.sum(), 1e-300)))

    def by(self, owner: IntArray, n: int) -> tuple[FloatArray, FloatArray]:
        """The same for each of n owners, given the owner of each image: ratios (n,), degrees of freedom (n,).

        An owner without observations has the ratio 0.
        """
        of = owner[self.image]
        square = np.bincount(of, self.square, minlength=n)
        freedom = np.asarray(np.bincount(of, self.expected, minlength=n), dtype=float)
        return np.sqrt(square / freedom.clip(1e-300)), freedom
