"""An image resampled at given pixels by its cubic spline."""

import math

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.splines import Coefficients, spline_at
from pancam_graph.terrain.kernel._compiling import entry

__all__ = ["resample"]


@entry
def resample(
    first: int, last: int, coefficients: Coefficients, uv_px: FloatArray, out: NDArray[np.float32]
) -> None:
    """Write rows `first` to `last` of `out` (h, w): the image at pixels `uv_px` (h, w, 2); 0 where NaN."""
    for row in range(first, last):
        for column in range(out.shape[1]):
            u, v = uv_px[row, column, 0], uv_px[row, column, 1]
            value = 0.0
            if not (math.isnan(u) or math.isnan(v)):
                value = spline_at(coefficients, u, v)
            out[row, column] = value
