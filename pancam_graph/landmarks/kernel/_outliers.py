"""Covariances of residuals, test statistics made with them, and which observations are rejected."""

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks.kernel._compiling import entry
from pancam_graph.landmarks.kernel._observe import Seen, observe_ray, residual_by_ray
from pancam_graph.landmarks.kernel._symmetric import add_row, diagonalise

__all__ = ["cofactors", "reject", "residual_tests", "smallest_information"]

_MIN_REDUNDANCY = 0.02
"""A direction of a residual is not tested if its variance is below this share of the noise's: its landmark
follows the observation there, and an error does not show."""


@entry
def cofactors(which: IntArray, begin: IntArray, b: FloatArray, weight: FloatArray, out: FloatArray) -> None:
    """Covariances of whitened residuals, cameras held, to `out` (n, 2, 2); see `landmarks.residual_cofactor`.

    `b` (n, 2, 3) are the derivatives of the residuals, `weight` (n,) is 0 for observations that take no part.
    """
    v, turn = np.empty((3, 3)), np.empty((3, 3))
    for j in which:
        v[:] = 0.0
        for i in range(begin[j], begin[j + 1]):
            for m in range(2):
                add_row(v, weight[i], b[i, m, 0], b[i, m, 1], b[i, m, 2])
        diagonalise(v, turn)
        # A direction that the rays leave free has no finite variance: this floor stands for its information.
        least = 1e-14 * max(v[0, 0], v[1, 1], v[2, 2]) + 1e-100
        for i in range(begin[j], begin[j + 1]):
            sign = -weight[i] if weight[i] > 0 else 1.0
            c00, c01, c11 = 1.0, 0.0, 1.0
            for k in range(3):
                share = sign / max(v[k, k], least)
                h0 = b[i, 0, 0] * turn[0, k] + b[i, 0, 1] * turn[1, k] + b[i, 0, 2] * turn[2, k]
                h1 = b[i, 1, 0] * turn[0, k] + b[i, 1, 1] * turn[1, k] + b[i, 1, 2] * turn[2, k]
                c00 += share * h0 * h0
                c01 += share * h0 * h1
                c11 += share * h1 * h1
            out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = c00, c01, c01, c11


@entry
def smallest_information(
    which: IntArray, seen: Seen, points_m: FloatArray, weight: FloatArray, out: FloatArray
) -> None:
    """Smallest eigenvalue of the information about world points (landmarks, 3), in 1 / m^2, to `out`."""
    cameras = seen.cameras
    v, turn = np.empty((3, 3)), np.empty((3, 3))
    for j in which:
        v[:] = 0.0
        for i in range(seen.begin[j], seen.begin[j + 1]):
            if weight[i] > 0:
                image = seen.image[i]
                y0 = points_m[j, 0] - cameras.centre_m[image, 0]
                y1 = points_m[j, 1] - cameras.centre_m[image, 1]
                y2 = points_m[j, 2] - cameras.centre_m[image, 2]
                _, _, _, u, v_px, per_depth = observe_ray(
                    cameras, image, y0, y1, y2, 1.0, seen.uv_px, seen.whitening, i
                )
                d00, d01, d02, d10, d11, d12, _, _ = residual_by_ray(
                    cameras, image, y0, y1, y2, 1.0, u, v_px, per_depth, seen.whitening, i
                )
                add_row(v, weight[i], d00, d01, d02)
                add_row(v, weight[i], d10, d11, d12)
        diagonalise(v, turn)
        out[j] = min(v[0, 0], v[1, 1], v[2, 2])


@entry
def residual_tests(
    which: IntArray,
    begin: IntArray,
    residual: FloatArray,
    cofactor: FloatArray,
    test: FloatArray,
    freedom: IntArray,
) -> None:
    """Squared residuals (n,) in units of their own covariance `cofactor` (n, 2, 2), to `test` (n,).

    `freedom` (n,) gets the number of directions (0, 1 or 2) that a test is made of.
    """
    values, turn = np.empty((2, 2)), np.empty((2, 2))
    for j in which:
        for i in range(begin[j], begin[j + 1]):
            for p in range(2):
                for q in range(2):
                    values[p, q] = cofactor[i, p, q]
            diagonalise(values, turn)
            test[i], freedom[i] = 0.0, 0
            for k in range(2):
                if values[k, k] > _MIN_REDUNDANCY:
                    along = turn[0, k] * residual[i, 0] + turn[1, k] * residual[i, 1]
                    test[i] += along * along / values[k, k]
                    freedom[i] += 1


@entry
def reject(
    which: IntArray,
    begin: IntArray,
    residual: FloatArray,
    test: FloatArray,
    freedom: IntArray,
    in_front: BoolArray,
    scale: float,
    limit: FloatArray,
    readmit: bool,
    weight: FloatArray,
    lost: BoolArray,
    changed: BoolArray,
) -> None:
    """Set the weight (n,) of each landmark's worst observation to 0 if its test exceeds its limit.

    `limit` (3,) is by number of directions, in units of the squared `scale`. `test` is overwritten. If a
    landmark has only two accepted observations, both may be rejected, for nothing tells which is wrong. With
    `readmit`, rejected observations that fit get weight 1. `lost` (landmarks,) says which landmarks lost an
    observation, `changed` (landmarks,) which lost or regained one.
    """
    excess = test
    for j in which:
        n_accepted, worst = 0, 0.0
        for i in range(begin[j], begin[j + 1]):
            excess[i] = test[i] / scale**2 - limit[freedom[i]]
            if weight[i] > 0:
                # Also a residual that its own covariance cannot test must not exceed the noise.
                squared = residual[i, 0] * residual[i, 0] + residual[i, 1] * residual[i, 1]
                excess[i] = max(excess[i], squared / scale**2 - limit[2])
                n_accepted += 1
            if not in_front[i]:
                excess[i] = np.inf
            if weight[i] > 0:
                worst = max(worst, excess[i])
        n_left = n_accepted
        for i in range(begin[j], begin[j + 1]):
            if weight[i] > 0 and excess[i] > 0 and (excess[i] >= worst or n_accepted <= 2):
                weight[i] = 0.0
                n_left -= 1
        n_back = 0
        if readmit and n_left >= 2:
            for i in range(begin[j], begin[j + 1]):
                # An observation that was just rejected exceeds its limit, and is not readmitted.
                if weight[i] == 0 and excess[i] < 0 and freedom[i] > 0:
                    weight[i] = 1.0
                    n_back += 1
        lost[j] = n_left < n_accepted
        changed[j] = lost[j] or n_back > 0
