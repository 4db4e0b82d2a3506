"""Data snooping: observations that their landmark contradicts are rejected, with cameras held.

Each residual is compared with the covariance that noise alone gives it; the covariance takes into account
that the landmark follows its own observations (Baarda 1968). A track loses its worst observation only, is
triangulated again, and so on. A rejected observation that fits again is accepted again.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks import (
    SETTLED,
    SQUARED,
    CameraViews,
    Landmarks,
    Measurements,
    as_floats,
    kernel,
    over_landmarks,
    rays_of,
    seen_by,
)

__all__ = ["Snooping", "snoop"]

_SWEEPS = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class Snooping:
    """Outcome of data snooping: which observations to believe."""

    landmarks: Landmarks
    accepted: BoolArray
    """(n,)"""
    scale: float
    """Robust estimate of the noise, in units of the given sigmas."""
    behind: BoolArray
    """(n,) whether the landmark lies behind the camera."""


def snoop(
    landmarks: Landmarks,
    measurements: Measurements,
    views: CameraViews,
    accepted: BoolArray,
    *,
    cutoff_sigma: float,
    min_scale: float,
    scale: float | None = None,
) -> Snooping:
    """Observations to accept, and where their landmarks then are, with all cameras held.

    `accepted` (n,) are the observations to start from. An observation is rejected if its test exceeds the
    chi-square quantile whose tail is that of a Gaussian beyond `cutoff_sigma`. Tests are in units of the
    noise scale: `scale` where it is given, else a robust estimate that is at least `min_scale`. Give `scale`
    where the landmarks are only a suspect part of all, so that the estimate would be too large. If two
    observations are all that a track has and they disagree, both are rejected, since nothing tells which is
    wrong.
    """
    seen, n, n_landmarks = seen_by(measurements, views), len(measurements.image), measurements.n_landmarks
    begin, starts = measurements.begin, measurements.starts
    centre, direction = rays_of(measurements, views)
    vector = as_floats(landmarks.vector, (n_landmarks, 4)).copy()
    origin = as_floats(landmarks.origin_m, (n_landmarks, 3)).copy()
    weight = as_floats(_revived(accepted, measurements), (n,))
    residual, b, cofactor = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 2, 2))
    test, freedom, in_front = np.empty(n), np.empty(n, dtype=np.int64), np.empty(n, dtype=bool)
    lost, changed = np.empty(n_landmarks, dtype=bool), np.empty(n_landmarks, dtype=bool)
    tail = scipy.special.erfc(
        cutoff_sigma / np.sqrt(2.0)
    )  # share of a Gaussian beyond the cutoff, on both sides
    limit = np.array([np.inf, scipy.special.chdtri(1, tail), scipy.special.chdtri(2, tail)])
    known, scale = scale, min_scale if scale is None else scale
    which = np.arange(n_landmarks)
    fresh = np.flatnonzero(np.minimum.reduceat(weight, starts) > 0)
    for sweep in range(_SWEEPS):
        over_landmarks(kernel.triangulate, fresh, begin, centre, direction, weight, vector, origin)
        over_landmarks(
            kernel.refine,
            which,
            seen,
            origin,
            weight,
            SQUARED.kind,
            SQUARED.width,
            False,
            SETTLED,
            vector,
        )
        over_landmarks(kernel.evaluate, which, seen, vector, origin, residual, b, in_front)
        over_landmarks(kernel.free_derivatives, which, begin, vector, b)
        over_landmarks(kernel.cofactors, which, begin, b, weight, cofactor)
        over_landmarks(kernel.residual_tests, which, begin, residual, cofactor, test, freedom)
        if sweep == 0 and known is None:
            counts = (weight > 0) & in_front
            scale = max(min_scale, _robust_scale(test[counts], freedom[counts]))
        over_landmarks(
            kernel.reject,
            which,
            begin,
            residual,
            test,
            freedom,
            in_front,
            scale,
            limit,
            sweep == 0,
            weight,
            lost,
            changed,
        )
        which = which[changed[which]]
        if len(which) == 0:
            break
        fresh = which[lost[which] & (np.add.reduceat(weight, starts)[which] > 0)]
    return Snooping(
        landmarks=Landmarks(vector=vector, origin_m=origin),
        accepted=weight > 0,
        scale=scale,
        behind=~in_front,
    )


def _revived(accepted: BoolArray, measurements: Measurements) -> BoolArray:
    """Accepted observations (n,), with all observations of landmarks that have fewer than two accepted."""
    k = measurements.landmark
    few = np.bincount(k, accepted, minlength=measurements.n_landmarks) < 2
    return np.asarray(accepted | few[k])


def _robust_scale(test: FloatArray, dof: IntArray) -> float:
    """Noise scale: root of the median of the tests, each divided by its median under noise of scale 1."""
    expected = np.array([np.nan, scipy.special.chdtri(1, 0.5), scipy.special.chdtri(2, 0.5)])
    ratio = test[dof > 0] / expected[dof[dof > 0]]
    return float(np.sqrt(np.median(ratio))) if len(ratio) else 0.0
