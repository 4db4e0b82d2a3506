"""Limits that right solutions exceed only by a small chance."""

import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.chances import chi_square_limit, normal_limit
from pancam_graph.base.geometry import FloatArray

__all__ = ["CHANCE", "rms_limit", "two_sided_limit"]

CHANCE = 2e-4
"""Chance that a right solution fails one statistical test."""


def two_sided_limit(n: int, chance: float) -> float:
    """Size that the largest of n standard normal numbers exceeds with at most this chance, either side."""
    return normal_limit(chance / (2 * max(n, 1)))


def rms_limit(freedom: ArrayLike, chance: float) -> FloatArray:
    """RMS that the root of chi-square over its degrees of freedom (n,) exceeds with this chance (n,)."""
    n = np.maximum(freedom, 1e-3)
    return np.asarray(np.sqrt(chi_square_limit(n, chance) / n))
