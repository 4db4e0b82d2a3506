"""The surface that one frame sees, drawn on a grid from above."""

import math

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.terrain.kernel._compiling import entry

__all__ = ["raster_quads"]


@entry
def raster_quads(
    points: FloatArray,
    variance: NDArray[np.float32],
    grey: NDArray[np.float32],
    disparity_px: NDArray[np.float32],
    jump_px: float,
    independent: float,
    total: NDArray[np.float32],
) -> None:
    """Draw the points and the meshes of a range image on a grid.

    `points` (h, w, 3) are column and row of the grid, in cells, and height, metres; NaN: none. `variance`
    (h, w) is that of the height, `grey` (h, w) the brightness. Neighbours whose `disparity_px` (h, w) differ
    by `jump_px` or more are not on one surface: what lies between them is hidden. `total` (5, rows, columns),
    zero at first, gets weight, weighted height, brightness, count of points, and variance of the mean of each
    cell. A cell with
    points has their weighted mean; as neighbours err alike, only one in `independent` counts as a
    measurement. A cell between points of one surface has what a triangle of them has at its middle, and a
    count of 0.
    """
    h, w = variance.shape
    rows, columns = total.shape[1], total.shape[2]
    for y in range(h):
        for x in range(w):
            if math.isnan(points[y, x, 2]):
                continue
            c, r = math.floor(points[y, x, 0] + 0.5), math.floor(points[y, x, 1] + 0.5)
            if 0 <= c < columns and 0 <= r < rows:
                ww = 1 / variance[y, x]
                total[0, r, c] += ww
                total[1, r, c] += ww * points[y, x, 2]
                total[2, r, c] += ww * grey[y, x]
                total[3, r, c] += 1
    for r in range(rows):
        for c in range(columns):
            if total[3, r, c] > 0:
                total[1, r, c] /= total[0, r, c]
                total[2, r, c] /= total[0, r, c]
                total[4, r, c] = min(total[3, r, c], independent) / total[0, r, c]
    for y in range(h - 1):
        for x in range(w - 1):
            for half in range(2):
                y0, x0 = y + half, x + half
                z0, z1, z2 = points[y0, x0, 2], points[y, x + 1, 2], points[y + 1, x, 2]
                if math.isnan(z0) or math.isnan(z1) or math.isnan(z2):
                    continue
                d0, d1, d2 = disparity_px[y0, x0], disparity_px[y, x + 1], disparity_px[y + 1, x]
                if max(d0, d1, d2) - min(d0, d1, d2) >= jump_px:
                    continue
                ax, ay = points[y0, x0, 0], points[y0, x0, 1]
                bx, by = points[y, x + 1, 0], points[y, x + 1, 1]
                cx, cy = points[y + 1, x, 0], points[y + 1, x, 1]
                low_x, high_x = min(ax, bx, cx), max(ax, bx, cx)
                low_y, high_y = min(ay, by, cy), max(ay, by, cy)
                det = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
                if abs(det) < 1e-9:
                    continue
                for r in range(max(math.ceil(low_y), 0), min(math.floor(high_y), rows - 1) + 1):
                    for c in range(max(math.ceil(low_x), 0), min(math.floor(high_x), columns - 1) + 1):
                        if total[3, r, c] > 0:
                            continue
                        u = ((c - ax) * (cy - ay) - (cx - ax) * (r - ay)) / det
                        v = ((bx - ax) * (r - ay) - (c - ax) * (by - ay)) / det
                        if u < 0 or v < 0 or u + v > 1:
                            continue
                        t = 1 - u - v
                        height = t * z0 + u * z1 + v * z2
                        # Of two layers of one frame the upper one is seen from above.
                        if total[0, r, c] > 0 and total[1, r, c] >= height:
                            continue
                        variance_m2 = t * variance[y0, x0] + u * variance[y, x + 1] + v * variance[y + 1, x]
                        total[0, r, c] = 1 / variance_m2
                        total[1, r, c] = height
                        total[2, r, c] = t * grey[y0, x0] + u * grey[y, x + 1] + v * grey[y + 1, x]
                        total[4, r, c] = variance_m2
