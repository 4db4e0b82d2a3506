"""Disparity to a fraction of a pixel: least-squares matching of slanted windows (Gruen 1985).

Within a window the disparity is a plane, d + a x + b y, and brightness differs by a gain and an offset. A
window that is not slanted takes the mean over the relief within it for its middle, and a disparity of whole
pixels is where a parabola through costs is drawn to.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray
from pancam_graph.terrain.kernel._compiling import entry

__all__ = ["FINER", "refine_rows"]

FINER = 8
"""Columns of the second image a pixel: between them brightness is linear."""

_HALF_PX = 3
_WEIGHT_PX = 2.0
_SAME_SURFACE_PX = 0.75
"""Distance of a start from the window's plane at which its weight is a quarter."""
_STEPS = 4
_CONVERGED_PX = 0.01
_LARGEST_STEP_PX, _LARGEST_SLOPE_STEP = 0.5, 0.1
_FARTHEST_PX = 1.5
"""How far a result may lie from its start."""
_LEAST_WEIGHT = 0.25
"""Share of a window's weight that must lie in both images, on the surface of its middle."""
_FLAT = 1.0
"""Weight of a prior of slopes about those of the start, a share of what the window says of its middle."""


@part
def _plane(
    taps: int,
    u: FloatArray,
    v: FloatArray,
    off: FloatArray,
    first_weight: FloatArray,
    weight: FloatArray,
) -> tuple[float, float, float, float]:
    """The plane of the starts around a pixel, those of other surfaces left out.

    Returns the sum of the weights, which are written, the plane at the middle, and its slopes along x and y.
    """
    a, b, middle, s0 = 0.0, 0.0, 0.0, 0.0
    for _ in range(2):
        s0 = sx = sy = sxx = sxy = syy = sd = sxd = syd = 0.0
        for k in range(taps):
            out = (off[k] - a * u[k] - b * v[k]) / _SAME_SURFACE_PX
            ww = first_weight[k] / ((1 + out * out) * (1 + out * out))
            weight[k] = ww
            wu, wv, wo = ww * u[k], ww * v[k], ww * off[k]
            s0 += ww
            sx += wu
            sy += wv
            sxx += wu * u[k]
            sxy += wu * v[k]
            syy += wv * v[k]
            sd += wo
            sxd += wu * off[k]
            syd += wv * off[k]
        if s0 < 2:
            return s0, 0.0, a, b
        mx, my = sx / s0, sy / s0
        cxx, cxy, cyy = sxx - sx * mx + 0.02 * s0, sxy - sx * my, syy - sy * my + 0.02 * s0
        bx, by = sxd - mx * sd, syd - my * sd
        det = cxx * cyy - cxy * cxy
        a, b = (cyy * bx - cxy * by) / det, (cxx * by - cxy * bx) / det
        middle = sd / s0 - a * mx - b * my
    return s0, middle, a, b


@entry
def refine_rows(
    first: int,
    last: int,
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    start_px: NDArray[np.float32],
    disparity_px: NDArray[np.float32],
    spread_px: NDArray[np.float32],
) -> None:
    """Refine the disparities of rows `first` to `last`.

    `left` (h, w) and `right` (h, FINER w) are rectified: a pixel (x, y) of the left lies at (x - d, y) of the
    right, whose columns are `1 / FINER` pixel apart. `start_px` (h, w) is right within a pixel; NaN: not
    known. Written are `disparity_px`, NaN where nothing is found, and `spread_px`: the deviation of what is
    left between the windows, carried through the inverse of the normal matrix.
    """
    h, w = left.shape
    side = 2 * _HALF_PX + 1
    n = side * side
    over = right.shape[1] - FINER - 1
    near, aside, down = np.empty(n), np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    for k in range(n):
        aside[k], down[k] = k % side - _HALF_PX, k // side - _HALF_PX
        near[k] = math.exp(-0.5 * (aside[k] ** 2 + down[k] ** 2) / _WEIGHT_PX**2)
    # The taps of a window that count: where they are from its middle, their start and their weight.
    u, v, off, first_weight = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    weight, row = np.empty(n), np.empty(n, dtype=np.int64)
    value, own_gradient, other, gradient = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for y in range(first, last):
        for x in range(w):
            disparity_px[y, x] = math.nan
            spread_px[y, x] = math.nan
            d = float(start_px[y, x])
            if math.isnan(d):
                continue
            taps = 0
            for k in range(n):
                yy, xx = y + down[k], x + aside[k]
                if yy < 0 or yy >= h or xx < 0 or xx >= w:
                    continue
                own = start_px[yy, xx]
                # A comparison with NaN is false.
                if 1 <= xx - own < w - 2:
                    u[taps], v[taps], off[taps], first_weight[taps] = aside[k], down[k], own - d, near[k]
                    row[taps] = yy
                    value[taps] = left[yy, xx]
                    own_gradient[taps] = 0.5 * (left[yy, min(xx + 1, w - 1)] - left[yy, max(xx - 1, 0)])
                    taps += 1
            s0, off_middle, a, b = _plane(taps, u, v, off, first_weight, weight)
            d += off_middle
            if s0 < _LEAST_WEIGHT * 2 * math.pi * _WEIGHT_PX**2:
                continue
            mean = own_square = 0.0
            for k in range(taps):
                mean += weight[k] * value[k]
                own_square += weight[k] * value[k] * value[k]
            mean /= s0
            own_square = own_square / s0 - mean * mean
            left_over, inverse, begin, found = 0.0, 0.0, d, True
            for _ in range(_STEPS):
                far = far_square = 0.0
                for k in range(taps):
                    at = min(max(FINER * (x + u[k] - d - a * u[k] - b * v[k]), 0.0), over)
                    c = int(at)
                    p, q = right[row[k], c], right[row[k], c + 1]
                    here = p + (at - c) * (q - p)
                    other[k], gradient[k] = here, FINER * (q - p)
                    far += weight[k] * here
                    far_square += weight[k] * here * here
                far /= s0
                far_square = far_square / s0 - far * far
                gain = min(max(math.sqrt((own_square + 1e-6) / (far_square + 1e-6)), 0.5), 2.0)
                m0 = m1 = m2 = 0.0
                for k in range(taps):
                    # The mean of both images' gradients: no image is the one that is right.
                    gradient[k] = 0.5 * (own_gradient[k] + gain * gradient[k])
                    g = weight[k] * gradient[k]
                    m0 += g
                    m1 += g * u[k]
                    m2 += g * v[k]
                m0, m1, m2 = m0 / s0, m1 / s0, m2 / s0
                a00 = a01 = a02 = a11 = a12 = a22 = b0 = b1 = b2 = left_over = 0.0
                for k in range(taps):
                    g = gradient[k]
                    j0, j1, j2 = g - m0, g * u[k] - m1, g * v[k] - m2
                    e = value[k] - mean - gain * (other[k] - far)
                    w0, w1, w2, we = weight[k] * j0, weight[k] * j1, weight[k] * j2, weight[k] * e
                    a00 += w0 * j0
                    a01 += w0 * j1
                    a02 += w0 * j2
                    a11 += w1 * j1
                    a12 += w1 * j2
                    a22 += w2 * j2
                    b0 -= w0 * e
                    b1 -= w1 * e
                    b2 -= w2 * e
                    left_over += we * e
                a11 += _FLAT * a00 + 1e-6
                a22 += _FLAT * a00 + 1e-6
                a00 += 1e-3
                c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
                c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
                det = a00 * c00 + a01 * c01 + a02 * c02
                inverse = c00 / det
                step = (c00 * b0 + c01 * b1 + c02 * b2) / det
                d += min(max(step, -_LARGEST_STEP_PX), _LARGEST_STEP_PX)
                turn_a, turn_b = (
                    (c01 * b0 + c11 * b1 + c12 * b2) / det,
                    (c02 * b0 + c12 * b1 + c22 * b2) / det,
                )
                a += min(max(turn_a, -_LARGEST_SLOPE_STEP), _LARGEST_SLOPE_STEP)
                b += min(max(turn_b, -_LARGEST_SLOPE_STEP), _LARGEST_SLOPE_STEP)
                found = abs(d - begin) < _FARTHEST_PX
                if not found or abs(step) < _CONVERGED_PX:
                    break
            if found:
                disparity_px[y, x] = d
                spread_px[y, x] = math.sqrt(max(left_over / s0 * inverse, 0.0))
