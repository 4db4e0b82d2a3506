"""Cubic splines of images: their coefficients, and their value between pixels in compiled loops."""

import math
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.compiled import part
from pancam_graph.base.geometry import FloatArray

__all__ = ["Coefficients", "spline_at", "spline_taps"]

Coefficients: TypeAlias = NDArray[np.float32]
"""Coefficients (height, width) of cubic splines."""

_BLUR_SIGMAS = 4
_INVERSE_PX = 12


@cache
def spline_taps(blur_px: float) -> FloatArray:
    """The filter, along one axis, that blurs an image and turns it to coefficients of cubic splines.

    A cubic spline with coefficients c is (c[-1] + 4 c[0] + c[1]) / 6 at a pixel. The inverse of that filter
    is sqrt(3) z^|k| with z = sqrt(3) - 2 (Unser, Aldroubi and Eden 1993), cut off where it is below 1e-7.
    A blur of 0 is none.
    """
    z, reach = np.sqrt(3) - 2, int(_BLUR_SIGMAS * blur_px + 0.5)
    inverse = np.sqrt(3) * z ** np.abs(np.arange(-_INVERSE_PX, _INVERSE_PX + 1))
    inverse /= inverse.sum()
    if blur_px == 0:
        return np.asarray(inverse)
    blur = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur_px) ** 2)
    return np.convolve(blur / blur.sum(), inverse)


@part
def spline_at(coefficients: Coefficients, u: float, v: float) -> float:
    """Brightness at a pixel; outside the image, that of the nearest pixel inside."""
    height, width = coefficients.shape
    u = min(max(u, 0.0), width - 1.0)
    v = min(max(v, 0.0), height - 1.0)
    i, j = math.floor(u), math.floor(v)
    x, y = u - i, v - j
    a0, a3 = (1 - x) ** 3 / 6, x**3 / 6
    a1, a2 = 2 / 3 - x * x + x**3 / 2, 2 / 3 - (1 - x) ** 2 + (1 - x) ** 3 / 2
    b0, b3 = (1 - y) ** 3 / 6, y**3 / 6
    b1, b2 = 2 / 3 - y * y + y**3 / 2, 2 / 3 - (1 - y) ** 2 + (1 - y) ** 3 / 2
    # Beyond the edge the coefficients are mirrored.
    i0, i2, i3 = abs(i - 1), min(i + 1, 2 * width - 3 - i), min(i + 2, 2 * width - 4 - i)
    value = 0.0
    for k in range(4):
        row = abs(j - 1 + k)
        if row > height - 1:
            row = 2 * height - 2 - row
        b = b0 if k == 0 else b1 if k == 1 else b2 if k == 2 else b3
        c = coefficients[row]
        value += b * (a0 * c[i0] + a1 * c[i] + a2 * c[i2] + a3 * c[i3])
    return value
