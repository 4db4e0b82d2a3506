"""Lenses of sensors that are no cameras: what is known of terrain points, as compiled loops see it.

A constraint on a point is an observation by a sensor at a known place, or at a stop, whose "pixel" is a
coordinate, an angle or an inverse range. K is the identity.
"""

from collections.abc import Callable
from enum import IntEnum

import numpy as np

from pancam_graph.base.compiled import uncounted
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras._lens import Distorted

__all__ = ["SENSORS", "SURFACE_HEAD", "Sensor"]


class Sensor(IntEnum):
    """Kinds of sensors, each its place in `SENSORS`."""

    COORDINATES = 0
    """(u, v): coordinates of the point along the sensor's x and y, metres; points at infinity are behind."""
    AZIMUTH = 1
    """u: azimuth of the point about the sensor's z, anticlockwise from its x, radians; v is 0."""
    ELEVATION = 2
    """u: elevation of the point above the sensor's x-y plane, radians; v is 0."""
    INVERSE_RANGE = 3
    """u: inverse distance of the point, 1/m; v is 0."""
    SURFACE = 4
    """u: height of the point above a surface, metres; v is 0. Points beside it are outside the domain."""


SURFACE_HEAD = 6
"""Numbers in the first row of a surface's table: x and y of its first node, steps along columns and rows,
numbers of rows and columns. The heights of its nodes follow, a row of the table each; NaN: there is none."""


@uncounted.part
def _coordinates(p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    return True, (d0, d1, w), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)), (0.0, 0.0, 1.0)


@uncounted.part
def _azimuth(p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    square = d0 * d0 + d1 * d1
    within = square > 0.0
    per = 1.0 / (square if within else 1.0)
    none = (0.0, 0.0, 0.0)
    return within, (np.arctan2(d1, d0), 0.0, 1.0), ((-d1 * per, d0 * per, 0.0), none, none), none


@uncounted.part
def _elevation(p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    level = np.sqrt(d0 * d0 + d1 * d1)
    within = level > 0.0
    per = 1.0 / (level * (level * level + d2 * d2) if within else 1.0)
    none = (0.0, 0.0, 0.0)
    by_ray = (-d2 * d0 * per, -d2 * d1 * per, level * level * per)
    return within, (np.arctan2(d2, level), 0.0, 1.0), (by_ray, none, none), none


@uncounted.part
def _inverse_range(p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    length = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    within = length > 0.0
    per = 1.0 / (length if within else 1.0)
    none = (0.0, 0.0, 0.0)
    return within, (w, 0.0, length), (none, none, (d0 * per, d1 * per, d2 * per)), (1.0, 0.0, 0.0)


@uncounted.part
def _surface(p: FloatArray, row: int, d0: float, d1: float, d2: float, w: float) -> Distorted:
    """Cubic convolution (Keys 1981, a = -1/2): smooth in value and slope, and exact for quadratic ground."""
    per = 1.0 / (w if w > 0.0 else 1.0)
    x, y = (d0 * per - p[row, 0]) / p[row, 2], (d1 * per - p[row, 1]) / p[row, 3]
    last_x, last_y = p[row, 5] - 2.0, p[row, 4] - 2.0
    within = w > 0.0 and x >= 1.0 and x <= last_x and y >= 1.0 and y <= last_y
    height, by_x, by_y = 0.0, 0.0, 0.0
    if within:
        i, j = min(int(x), int(last_x) - 1), min(int(y), int(last_y) - 1)
        s, t = x - i, y - j
        for k in range(4):
            along, slope = 0.0, 0.0
            for m in range(4):
                node = p[row + j + k, i - 1 + m]
                along += _cubic(m, s) * node
                slope += _cubic_slope(m, s) * node
            height += _cubic(k, t) * along
            by_x += _cubic(k, t) * slope / p[row, 2]
            by_y += _cubic_slope(k, t) * along / p[row, 3]
        within = not np.isnan(height)  # not beside a node without height
    if not within:
        height, by_x, by_y = 0.0, 0.0, 0.0
    none = (0.0, 0.0, 0.0)
    by_w = per * (by_x * d0 + by_y * d1) - height
    return within, (d2 - w * height, 0.0, w), ((-by_x, -by_y, 1.0), none, none), (by_w, 0.0, 1.0)


@uncounted.part
def _cubic(k: int, t: float) -> float:
    """Weight of the k-th of four nodes, the second of which is t before the place."""
    if k == 0:
        return ((1.0 - 0.5 * t) * t - 0.5) * t
    if k == 1:
        return (1.5 * t - 2.5) * t * t + 1.0
    if k == 2:
        return ((2.0 - 1.5 * t) * t + 0.5) * t
    return (0.5 * t - 0.5) * t * t


@uncounted.part
def _cubic_slope(k: int, t: float) -> float:
    """Derivative of `_cubic` by t."""
    if k == 0:
        return (2.0 - 1.5 * t) * t - 0.5
    if k == 1:
        return (4.5 * t - 5.0) * t
    if k == 2:
        return (4.0 - 4.5 * t) * t + 0.5
    return (1.5 * t - 1.0) * t


SENSORS: tuple[Callable[[FloatArray, int, float, float, float, float], Distorted], ...] = (
    _coordinates,
    _azimuth,
    _elevation,
    _inverse_range,
    _surface,
)
"""As `Distortion.distort`, by `Sensor`."""
