"""The surfaces of several frames as one, cell by cell."""

import math

import numpy as np
from numpy.typing import NDArray

from pancam_graph.terrain.kernel._compiling import entry

__all__ = ["fuse_cells"]

_MOST = 64
"""Frames of one cell that are fused; the others are left out."""
_FAR_SIGMAS = 3.0
"""Distance from the median, in sigmas of both, from which on a frame loses weight."""


@entry
def fuse_cells(
    height_m: NDArray[np.float32],
    variance_m2: NDArray[np.float32],
    grey: NDArray[np.float32],
    shared_m2: NDArray[np.float32],
    fused: NDArray[np.float32],
) -> None:
    """Fuse the heights of frames in cells: the mean by variances, robust against frames that are far off.

    `height_m`, `variance_m2`, `grey` and `shared_m2`, the variance of errors that frames have in common, are
    (frames, cells), NaN where a frame does not see a cell. `fused` (6, cells) gets height, its variance, the
    number of frames, their disagreement, brightness, and the mean of the variances in common. The
    disagreement is the weighted standard deviation between frames; NaN where fewer than two see the cell.
    """
    frames, cells = height_m.shape
    order, which = np.empty(_MOST), np.empty(_MOST, dtype=np.int64)
    for c in range(cells):
        n = 0
        for f in range(frames):
            if n < _MOST and not math.isnan(height_m[f, c]):
                value, at = float(height_m[f, c]), n
                while at > 0 and order[at - 1] > value:
                    order[at], which[at] = order[at - 1], which[at - 1]
                    at -= 1
                order[at], which[at] = value, f
                n += 1
        fused[0, c] = fused[1, c] = fused[3, c] = fused[4, c] = fused[5, c] = math.nan
        fused[2, c] = n
        if n == 0:
            continue
        median = order[n // 2] if n % 2 else 0.5 * (order[n // 2 - 1] + order[n // 2])
        total = mean = spread = information = light = common = 0.0
        for k in range(n):
            variance = float(variance_m2[which[k], c])
            ww = 1 / variance
            if n > 2:
                off = (order[k] - median) ** 2 / (_FAR_SIGMAS**2 * 2 * variance)
                ww /= 1 + off
            total += ww
            mean += ww * order[k]
            information += ww * ww * variance
            light += ww * grey[which[k], c]
            common += ww * shared_m2[which[k], c]
        mean /= total
        for k in range(n):
            variance = float(variance_m2[which[k], c])
            ww = 1 / variance
            if n > 2:
                ww /= 1 + (order[k] - median) ** 2 / (_FAR_SIGMAS**2 * 2 * variance)
            spread += ww * (order[k] - mean) ** 2
        fused[0, c] = mean
        fused[1, c] = information / (total * total)
        fused[4, c] = light / total
        fused[5, c] = common / total
        if n > 1:
            # What frames differ by beyond their sigmas is an error of some of them.
            fused[3, c] = math.sqrt(spread / total)
            fused[1, c] = max(fused[1, c], spread / total / n)
