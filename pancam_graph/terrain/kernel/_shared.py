"""Errors that a frame's places have in common, as variances of heights on a grid."""

import math

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import FloatArray
from pancam_graph.terrain.kernel._compiling import entry

__all__ = ["shared_variances"]


@entry
def shared_variances(
    x_m: FloatArray,
    y_m: FloatArray,
    height_m: NDArray[np.float32],
    step: int,
    steepest: float,
    world_R_camera: FloatArray,
    centre_m: FloatArray,
    extent: FloatArray,
    depth_m: FloatArray,
    covariance: FloatArray,
    variance_m2: NDArray[np.float32],
) -> None:
    """Variances of the heights of cells, from nodes of direction and depth (`data.StereoCovariance`).

    Cells have their middles at `x_m` (columns,) and `y_m` (rows,), and heights (rows, columns), NaN: none.
    An error of a place along the ground counts by the slope, over `step` cells to each side, at most
    `steepest`. `extent` (4,), `depth_m` (depths,) and `covariance` (depths, rows, columns, 6) are the nodes
    of the camera with the orientation and the centre that are given. `variance_m2` gets the variances, NaN
    where there is no height.
    """
    depths, down, across = covariance.shape[0], covariance.shape[1], covariance.shape[2]
    rows, columns = height_m.shape
    d, h, g, c = np.empty(3), np.empty(3), np.empty(3), np.empty(6)
    for r in range(rows):
        for k in range(columns):
            if math.isnan(height_m[r, k]):
                variance_m2[r, k] = math.nan
                continue
            h[0] = h[1] = 0.0
            h[2] = 1.0
            if step <= k < columns - step:
                run = x_m[k + step] - x_m[k - step]
                slope = (height_m[r, k + step] - height_m[r, k - step]) / run
                if not math.isnan(slope):
                    h[0] = -min(max(slope, -steepest), steepest)
            if step <= r < rows - step:
                run = y_m[r + step] - y_m[r - step]
                slope = (height_m[r + step, k] - height_m[r - step, k]) / run
                if not math.isnan(slope):
                    h[1] = -min(max(slope, -steepest), steepest)
            d[0], d[1], d[2] = x_m[k] - centre_m[0], y_m[r] - centre_m[1], height_m[r, k] - centre_m[2]
            z = max(
                world_R_camera[0, 2] * d[0] + world_R_camera[1, 2] * d[1] + world_R_camera[2, 2] * d[2], 1e-3
            )
            a = (world_R_camera[0, 0] * d[0] + world_R_camera[1, 0] * d[1] + world_R_camera[2, 0] * d[2]) / z
            b = (world_R_camera[0, 1] * d[0] + world_R_camera[1, 1] * d[1] + world_R_camera[2, 1] * d[2]) / z
            at_a = min(max((a - extent[0]) / (extent[1] - extent[0]), 0.0), 1.0) * (across - 1)
            at_b = min(max((b - extent[2]) / (extent[3] - extent[2]), 0.0), 1.0) * (down - 1)
            ia, ib, iz = min(int(at_a), across - 2), min(int(at_b), down - 2), 0
            while iz < depths - 2 and depth_m[iz + 1] <= z:
                iz += 1
            fa, fb = at_a - ia, at_b - ib
            fz = min(max((z - depth_m[iz]) / (depth_m[iz + 1] - depth_m[iz]), 0.0), 1.0)
            for e in range(6):
                c[e] = 0.0
            for corner in range(8):
                i, j, far = corner & 1, (corner >> 1) & 1, corner >> 2
                weight = (fa if i else 1 - fa) * (fb if j else 1 - fb) * (fz if far else 1 - fz)
                for e in range(6):
                    c[e] += weight * covariance[iz + far, ib + j, ia + i, e]
            # What lifts the surface at a place, in errors of x/z, of y/z, and of z over z.
            for i in range(3):
                g[i] = world_R_camera[0, i] * h[0] + world_R_camera[1, i] * h[1] + world_R_camera[2, i] * h[2]
            g[2] = -a * g[0] - b * g[1] - g[2]
            lifted = c[0] * g[0] * g[0] + c[3] * g[1] * g[1] + c[5] * g[2] * g[2]
            lifted += 2 * (c[1] * g[0] * g[1] + c[2] * g[0] * g[2] + c[4] * g[1] * g[2])
            variance_m2[r, k] = z * z * max(lifted, 0.0)
