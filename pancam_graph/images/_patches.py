"""Least-squares matching of patches (Gruen 1985), after a search by correlation: the compiled loop.

A patch of image a is compared with image b under a map from a to b, and any gain and offset. The map is
affine, with second derivatives that are given and stay: what perspective does to a patch beyond an affine map
moves all patches the same way, and would look like a turn of the camera. Images are given by their cubic
spline coefficients.
"""

import math
from pathlib import Path

import numpy as np

from pancam_graph.base import splines
from pancam_graph.base.compiled import Compiling, inlined, part
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.base.splines import Coefficients, spline_at
from pancam_graph.images._local_map import HALF_WIDTH_PX

__all__ = ["MAX_REACH_PX", "QUALITIES", "Coefficients", "align_patches"]

_entry = Compiling(parts_from=(Path(splines.__file__).parent,)).entry

MAX_REACH_PX = 12
"""The furthest that a search goes along u or v of image a."""

QUALITIES = 7
"""How many numbers `align_patches` says of each patch."""

_WEIGHT_PX = 4.0
_SIDE = 2 * HALF_WIDTH_PX + 1
_CONVERGED_PX = 0.01
_MAX_STEP_PX = 1.0
_MAX_AFFINE_STEP = 0.1
_SAME_PEAK_PX = 2


@part
def _standardise(patch: FloatArray, weight: FloatArray) -> float:
    """Subtract a patch's weighted mean and divide it by its standard deviation, which is returned."""
    mean = np.sum(patch * weight)
    patch -= mean
    spread = math.sqrt(max(np.sum(patch * patch * weight), 1e-12))
    patch /= spread
    return spread


@inlined
def _search(
    image_b: Coefficients,
    x: float,
    y: float,
    affine: tuple[float, float, float, float],
    rx: int,
    ry: int,
    template: FloatArray,
    weight: FloatArray,
    around: FloatArray,
    scores: FloatArray,
) -> tuple[float, float, float]:
    """The pixel of b around (x, y) whose patch has the highest correlation with the template.

    On a grid of pixels of a, up to `rx` and `ry` to either side. Returns the pixel, and the highest
    correlation away from it (-1: none). `around` and `scores` are overwritten.
    """
    m00, m01, m10, m11 = affine
    second = -1.0
    for j in range(_SIDE + 2 * ry):
        for i in range(_SIDE + 2 * rx):
            du, dv = i - HALF_WIDTH_PX - rx, j - HALF_WIDTH_PX - ry
            around[j, i] = spline_at(image_b, x + m00 * du + m01 * dv, y + m10 * du + m11 * dv)
    best, best_i, best_j = -2.0, rx, ry
    for j in range(2 * ry + 1):
        for i in range(2 * rx + 1):
            total, square, product = 0.0, 0.0, 0.0
            for k in range(len(weight)):
                w, value = weight[k], around[j + k // _SIDE, i + k % _SIDE]
                total += w * value
                square += w * value * value
                product += w * value * template[k]
            scores[j, i] = product / math.sqrt(max(square - total * total, 1e-12))
            if scores[j, i] > best:
                best, best_i, best_j = scores[j, i], i, j
    for j in range(2 * ry + 1):
        for i in range(2 * rx + 1):
            if max(abs(i - best_i), abs(j - best_j)) > _SAME_PEAK_PX:
                second = max(second, scores[j, i])
    du, dv = best_i - rx, best_j - ry
    x, y = x + m00 * du + m01 * dv, y + m10 * du + m11 * dv
    return x, y, second


@inlined
def _differentiate(
    image_a: Coefficients,
    u: float,
    v: float,
    contrast: float,
    affine: tuple[float, float, float, float],
    offset: FloatArray,
    weight: FloatArray,
    template: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Derivatives of the patch in b by two shifts and four entries of the map, to `jacobian` (taps, 6).

    The part that a gain or an offset could explain is taken out, as from the patches.
    """
    m00, m01, m10, m11 = affine
    determinant = m00 * m11 - m01 * m10
    for k in range(len(weight)):
        pu, pv = u + offset[k, 0], v + offset[k, 1]
        gu = (spline_at(image_a, pu + 0.5, pv) - spline_at(image_a, pu - 0.5, pv)) / contrast
        gv = (spline_at(image_a, pu, pv + 0.5) - spline_at(image_a, pu, pv - 0.5)) / contrast
        gx, gy = (gu * m11 - gv * m10) / determinant, (gv * m00 - gu * m01) / determinant
        jacobian[k] = (
            gx,
            gy,
            gx * offset[k, 0],
            gx * offset[k, 1],
            gy * offset[k, 0],
            gy * offset[k, 1],
        )
    for c in range(6):
        mean, along = 0.0, 0.0
        for k in range(len(weight)):
            mean += weight[k] * jacobian[k, c]
            along += weight[k] * template[k] * jacobian[k, c]
        for k in range(len(weight)):
            jacobian[k, c] -= mean + along * template[k]


@part
def _invert(normal: FloatArray, inverse: FloatArray) -> None:
    """Write the inverse of a positive definite matrix, of which the lower half is read and overwritten.

    NumPy's own is LAPACK's, which code that is called without Numba cannot reach.
    """
    n = len(normal)
    for c in range(n):  # its Cholesky factor L, with 1 / L_cc on the diagonal
        for r in range(c, n):
            value = normal[r, c]
            for k in range(c):
                value -= normal[r, k] * normal[c, k]
            normal[r, c] = value * normal[c, c] if r > c else 1.0 / math.sqrt(value)
    for c in range(n):  # L^-1, into the lower half
        inverse[c, c] = normal[c, c]
        for r in range(c + 1, n):
            value = 0.0
            for k in range(c, r):
                value -= normal[r, k] * inverse[k, c]
            inverse[r, c] = value * normal[r, r]
    for c in range(n):  # L^-T L^-1; what is read of L^-1 lies in rows from r on, not yet overwritten
        for r in range(c, n):
            value = 0.0
            for k in range(r, n):
                value += inverse[k, r] * inverse[k, c]
            inverse[r, c] = inverse[c, r] = value


@_entry
def align_patches(
    first: int,
    last: int,
    image_a: Coefficients,
    image_b: Coefficients,
    uv_a: FloatArray,
    affine: FloatArray,
    bend: FloatArray,
    reach: IntArray,
    steps: int,
    uv_b: FloatArray,
    quality: FloatArray,
) -> None:
    """Where the patches around pixels of a lie in b, for rows `first` to `last`.

    `uv_a` (n, 2); `affine` (n, 2, 2) is the derivative of the pixel in b by that in a, and `uv_b` (n, 2) the
    pixel in b, both at the start; `uv_b` is moved. `bend` (n, 2, 3) are the second derivatives of u and v in
    b by uu, uv and vv in a. `reach` (n, 2) is how many pixels of a the search by
    correlation goes from the start to either side, along u and v; it does without the bend. `quality` (n, 7)
    gets: the correlation where the least-squares matching starts; that where it ends; the second best of the
    search; the distance between start and end, in pixels of b; and the covariance of the end (uu, uv, vv), in
    squared pixels of b times a factor that is the same for all patches: the squared difference that is left
    between the patches, through the inverse of the normal matrix (Cramer and Rao).
    """
    n_taps = _SIDE * _SIDE
    offset, weight = np.empty((n_taps, 2)), np.empty(n_taps)
    for k in range(n_taps):
        offset[k, 0], offset[k, 1] = k % _SIDE - HALF_WIDTH_PX, k // _SIDE - HALF_WIDTH_PX
        weight[k] = math.exp(-0.5 * (offset[k, 0] ** 2 + offset[k, 1] ** 2) / _WEIGHT_PX**2)
    weight /= weight.sum()
    widest = _SIDE + 2 * MAX_REACH_PX
    template, patch, jacobian = np.empty(n_taps), np.empty(n_taps), np.empty((n_taps, 6))
    bent = np.empty((n_taps, 2))
    around, scores = np.empty((widest, widest)), np.empty((widest, widest))
    pull, change = np.empty(6), np.empty(6)
    normal, inverse = np.empty((6, 6)), np.empty((6, 6))
    for row in range(first, last):
        u, v = uv_a[row]
        for k in range(n_taps):
            template[k] = spline_at(image_a, u + offset[k, 0], v + offset[k, 1])
        contrast = _standardise(template, weight)
        m00, m01, m10, m11 = affine[row, 0, 0], affine[row, 0, 1], affine[row, 1, 0], affine[row, 1, 1]
        for k in range(n_taps):
            du, dv = offset[k, 0], offset[k, 1]
            for c in range(2):
                second_order = bend[row, c, 0] * du * du + bend[row, c, 2] * dv * dv
                bent[k, c] = 0.5 * second_order + bend[row, c, 1] * du * dv
        x, y = uv_b[row]

        rx, ry = reach[row]
        second = -1.0
        if rx > 0 or ry > 0:
            x, y, second = _search(
                image_b, x, y, (m00, m01, m10, m11), rx, ry, template, weight, around, scores
            )
        x_start, y_start = x, y

        _differentiate(image_a, u, v, contrast, (m00, m01, m10, m11), offset, weight, template, jacobian)
        normal[:] = 0.0
        for k in range(n_taps):
            for c in range(6):
                for d in range(c + 1):
                    normal[c, d] += weight[k] * jacobian[k, c] * jacobian[k, d]
        trace = 0.0
        for c in range(6):
            trace += normal[c, c]
        for c in range(6):
            normal[c, c] += 1e-9 * (1 + trace)
        _invert(normal, inverse)

        at_start, correlation, moving = -1.0, -1.0, True
        for step in range(steps + 1):
            for k in range(n_taps):
                du, dv = offset[k, 0], offset[k, 1]
                patch[k] = spline_at(
                    image_b, x + m00 * du + m01 * dv + bent[k, 0], y + m10 * du + m11 * dv + bent[k, 1]
                )
            _standardise(patch, weight)
            correlation = np.sum(weight * patch * template)
            if step == 0:
                at_start = correlation
            if step == steps or not moving:
                break
            pull[:] = 0.0
            for k in range(n_taps):
                error = weight[k] * (patch[k] - template[k])
                for c in range(6):
                    pull[c] -= error * jacobian[k, c]
            for c in range(6):
                change[c] = 0.0
                for d in range(6):
                    change[c] += inverse[c, d] * pull[d]
            x += min(max(change[0], -_MAX_STEP_PX), _MAX_STEP_PX)
            y += min(max(change[1], -_MAX_STEP_PX), _MAX_STEP_PX)
            m00 += min(max(change[2], -_MAX_AFFINE_STEP), _MAX_AFFINE_STEP)
            m01 += min(max(change[3], -_MAX_AFFINE_STEP), _MAX_AFFINE_STEP)
            m10 += min(max(change[4], -_MAX_AFFINE_STEP), _MAX_AFFINE_STEP)
            m11 += min(max(change[5], -_MAX_AFFINE_STEP), _MAX_AFFINE_STEP)
            moving = math.hypot(change[0], change[1]) > _CONVERGED_PX
        uv_b[row, 0], uv_b[row, 1] = x, y
        quality[row, 0], quality[row, 1], quality[row, 2] = at_start, correlation, second
        quality[row, 3] = math.hypot(x - x_start, y - y_start)
        # The patches' mean squared difference is 2 (1 - correlation).
        left = max(1.0 - correlation, 0.0)
        quality[row, 4], quality[row, 5] = left * inverse[0, 0], left * inverse[0, 1]
        quality[row, 6] = left * inverse[1, 1]
