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
from pancam_graph.solve._noise_scale import noise_scale

__all__ = ["Snooping", "pair_scale", "robust_scale", "snoop"]

_SUSPICIOUS = 3.0
"""The median of the tests is trusted up to this noise scale, or this multiple of the scale by pairs."""
_MOST_PAIRS = 20_000
"""Pairs of observations that the noise scale is estimated from, evenly drawn where a drive has more."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Snooping:
    """Outcome of data snooping: which observations to believe."""

    landmarks: Landmarks
    accepted: BoolArray
    """(n,) whether each observation is to be believed."""
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
    noise scale: `scale` where it is given, else an estimate that is at least `min_scale`: the median of the
    tests, or `pair_scale` where outliers are so many that the median is one of them. Give `scale` where the
    landmarks are only a suspect part of all, so that the estimate would be too large. If two observations
    are all that a track has and they disagree, both are rejected, since nothing tells which is wrong.
    """
    n_landmarks = measurements.n_landmarks
    weight = as_floats(_revived(accepted, measurements), (len(measurements.image),))
    tests = _Tests(measurements, views, weight, landmarks)
    tail = scipy.special.erfc(
        cutoff_sigma / np.sqrt(2.0)
    )  # share of a Gaussian beyond the cutoff, on both sides
    limit = np.array([np.inf, scipy.special.chdtri(1, tail), scipy.special.chdtri(2, tail)])
    lost, changed = np.empty(n_landmarks, dtype=bool), np.empty(n_landmarks, dtype=bool)
    which = np.arange(n_landmarks)
    fresh = np.flatnonzero(np.minimum.reduceat(weight, measurements.starts) > 0)
    readmit = True
    while len(which):  # each sweep takes an observation from every landmark that stays in it
        tests.update(which, fresh)
        if scale is None:
            scale = max(min_scale, robust_scale(tests.median_scale(), measurements, views))
        over_landmarks(
            kernel.reject,
            which,
            measurements.begin,
            tests.residual,
            tests.test,
            tests.freedom,
            tests.in_front,
            scale,
            limit,
            readmit,
            weight,
            lost,
            changed,
        )
        readmit = False
        which = which[changed[which]]
        fresh = which[lost[which] & (np.add.reduceat(weight, measurements.starts)[which] > 0)]
    return Snooping(
        landmarks=Landmarks(vector=tests.vector, origin_m=tests.origin),
        accepted=weight > 0,
        scale=min_scale if scale is None else scale,
        behind=~tests.in_front,
    )


def robust_scale(by_median: float, measurements: Measurements, views: CameraViews) -> float:
    """A noise scale `by_median` of residuals, or `pair_scale` where most of these must be outliers."""
    if by_median <= _SUSPICIOUS:
        return by_median
    by_pairs = pair_scale(measurements, views)
    return by_pairs if by_median > _SUSPICIOUS * by_pairs else by_median


def pair_scale(measurements: Measurements, views: CameraViews) -> float:
    """Noise scale of measurements, in units of their sigmas, with all cameras held.

    It is estimated from pairs of measurements that follow each other in a track. A pair is right if both of
    its measurements are, however many others of the track are wrong; of all pairs a tenth must be right
    (`noise_scale`). Rejected ones take part: the rest alone would have lost the tail of its noise, and so
    seem less noisy than it is. 0 if no landmark has two measurements.
    """
    first = np.flatnonzero(np.diff(measurements.landmark) == 0)
    if len(first) > _MOST_PAIRS:
        first = first[np.linspace(0, len(first) - 1, _MOST_PAIRS).astype(np.int64)]
    if len(first) == 0:
        return 0.0
    row = np.column_stack([first, first + 1]).ravel()
    pairs = Measurements(
        row=row,
        image=measurements.image[row],
        landmark=np.repeat(np.arange(len(first)), 2),
        uv_px=measurements.uv_px[row],
        whitening=measurements.whitening[row],
    )
    tests = _Tests(pairs, views, np.ones(len(row)))
    which = np.arange(len(first))
    tests.update(which, which)
    is_in_front = tests.in_front[::2] & tests.in_front[1::2]
    # Both tests of a pair are the same: the distance of its rays.
    return noise_scale(tests.test[::2][is_in_front], tests.freedom[::2][is_in_front])


class _Tests:
    """Landmarks where weighted measurements place them, cameras held, and a test of each measurement."""

    def __init__(
        self,
        measurements: Measurements,
        views: CameraViews,
        weight: FloatArray,
        landmarks: Landmarks | None = None,
    ) -> None:
        """`weight` (n,) is read by each update; refinement starts from `landmarks`, if there are any."""
        n, n_landmarks = len(measurements.image), measurements.n_landmarks
        self._begin, self._weight = measurements.begin, weight
        self._seen = seen_by(measurements, views)
        self._rays = rays_of(measurements, views)
        self.vector, self.origin = np.empty((n_landmarks, 4)), np.empty((n_landmarks, 3))
        """(landmarks, 4) and (landmarks, 3) as in `Landmarks`."""
        if landmarks is not None:
            self.vector[:], self.origin[:] = landmarks.vector, landmarks.origin_m
        self.residual, self._b, self._cofactor = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 2, 2))
        """(n, 2) whitened residuals."""
        self.test, self.freedom = np.empty(n), np.empty(n, dtype=np.int64)
        """(n,) squared residuals in units of their own covariance, and the number of squares in each."""
        self.in_front = np.empty(n, dtype=bool)
        """(n,) whether the landmark lies in front of the camera."""

    def median_scale(self) -> float:
        """Noise scale from the median of the tests of weighted measurements that their cameras have in front.

        Each test is divided by the median that noise of scale 1 would give it. 0 where there is no test.
        """
        rows = (self._weight > 0) & self.in_front & (self.freedom > 0)
        expected = np.array([np.nan, scipy.special.chdtri(1, 0.5), scipy.special.chdtri(2, 0.5)])
        ratio = self.test[rows] / expected[self.freedom[rows]]
        return float(np.sqrt(np.median(ratio))) if len(ratio) else 0.0

    def update(self, which: IntArray, fresh: IntArray) -> None:
        """Triangulate landmarks `fresh`, refine landmarks `which`, and test the measurements of these."""
        begin, weight, b = self._begin, self._weight, self._b
        over_landmarks(kernel.triangulate, fresh, begin, *self._rays, weight, self.vector, self.origin)
        over_landmarks(
            kernel.refine,
            which,
            self._seen,
            self.origin,
            weight,
            SQUARED.kind,
            SQUARED.width,
            False,
            SETTLED,
            self.vector,
        )
        over_landmarks(
            kernel.evaluate, which, self._seen, self.vector, self.origin, self.residual, b, self.in_front
        )
        over_landmarks(kernel.free_derivatives, which, begin, self.vector, b)
        over_landmarks(kernel.cofactors, which, begin, b, weight, self._cofactor)
        over_landmarks(
            kernel.residual_tests, which, begin, self.residual, self._cofactor, self.test, self.freedom
        )


def _revived(accepted: BoolArray, measurements: Measurements) -> BoolArray:
    """Accepted observations (n,), with all observations of landmarks that have fewer than two accepted."""
    k = measurements.landmark
    few = np.bincount(k, accepted, minlength=measurements.n_landmarks) < 2
    return np.asarray(accepted | few[k])
