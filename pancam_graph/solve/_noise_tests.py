"""Residuals against the noise that observations state: over all, by camera and by image."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.landmarks import SQUARED
from pancam_graph.solve._problem import Problem

__all__ = ["Residuals"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """Sums of squared whitened residuals of the observations in use, and what noise alone would give."""

    n_observations: int
    """Number of residuals."""
    n_not_finite: int
    """Number of residuals that are no numbers."""
    square: FloatArray
    """(images,) sum of squared lengths of the residuals of each image"""
    expected: FloatArray
    """(images,) its expectation: of each, 2 less an even share of the three numbers of its landmark"""

    @staticmethod
    def of(problem: Problem) -> "Residuals":
        """Residuals of a problem at its values."""
        m, n_images = problem.measurements, len(problem.template.traverse.images)
        rows = np.flatnonzero(problem.kept)
        image, landmark = m.image[rows], m.landmark[rows]
        square = SQUARED.cost(problem.residuals[0])[rows] * 2
        views = np.bincount(landmark, minlength=m.n_landmarks)
        expected = (2 - 3 / views.clip(1))[landmark]
        of_image, of_noise = (
            np.asarray(np.bincount(image, each, minlength=n_images), dtype=float)
            for each in (square, expected)
        )
        return Residuals(
            n_observations=len(rows),
            n_not_finite=int(np.count_nonzero(~np.isfinite(square))),
            square=of_image,
            expected=of_noise,
        )

    @property
    def ratio(self) -> float:
        """RMS residual over what the stated noise would make it."""
        return float(np.sqrt(self.square.sum() / max(self.expected.sum(), 1e-300)))

    def by(self, owner: IntArray, n: int) -> tuple[FloatArray, FloatArray]:
        """The same for each of n owners, given the owner of each image: ratios (n,), degrees of freedom (n,).

        An owner without observations has the ratio 0.
        """
        square = np.bincount(owner, self.square, minlength=n)
        freedom = np.asarray(np.bincount(owner, self.expected, minlength=n), dtype=float)
        return np.sqrt(square / freedom.clip(1e-300)), freedom
