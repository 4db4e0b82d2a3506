"""Joint prior: vectors whose errors are correlated (one row for each of their components)."""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.factors._slots import Key, custom_factor

__all__ = [
    "conditional_prior_factor",
    "conditional_prior_residual",
    "joint_prior_factor",
    "joint_prior_residual",
]


def joint_prior_residual(
    measured: FloatArray, *vectors: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Residuals (1, n), and Jacobians (1, n, k) by each vector (1, k).

    The residual is the vectors one after the other, less `measured` (n,).
    """
    residual = np.concatenate(vectors, axis=1) - measured
    end = np.cumsum([v.shape[1] for v in vectors])
    eye = np.eye(len(measured))[None]
    return residual, tuple(eye[:, :, e - v.shape[1] : e] for e, v in zip(end, vectors, strict=True))


def joint_prior_factor(
    noise: gtsam.noiseModel.Base, vectors: Sequence[Key], measured: FloatArray
) -> gtsam.CustomFactor:
    """The factor of `joint_prior_residual` on variables that are vectors; the noise has a row a component."""

    def residual(*values: FloatArray) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        return joint_prior_residual(measured, *values)

    return custom_factor(noise, [(key, "vector") for key in vectors], residual)


def conditional_prior_residual(
    rows: FloatArray, *vectors: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Residuals (1, m), and Jacobians (1, m, k) by each vector (1, k), of a zero-mean Gaussian.

    The residual is `rows` (m, n) times the vectors one after the other. With the last m rows of the inverse
    of the lower triangular square root of a covariance, it is the whitened error of the last m components
    given the others.
    """
    residual = np.concatenate(vectors, axis=1) @ rows.T
    end = np.cumsum([v.shape[1] for v in vectors])
    return residual, tuple(rows[None, :, e - v.shape[1] : e] for e, v in zip(end, vectors, strict=True))


def conditional_prior_factor(rows: FloatArray, vectors: Sequence[Key]) -> gtsam.CustomFactor:
    """The factor of `conditional_prior_residual` on variables that are vectors, with unit noise."""

    def residual(*values: FloatArray) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        return conditional_prior_residual(rows, *values)

    noise = gtsam.noiseModel.Unit.Create(len(rows))
    return custom_factor(noise, [(key, "vector") for key in vectors], residual)
