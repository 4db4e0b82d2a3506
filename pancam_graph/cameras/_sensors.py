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

__all__ = ["SENSORS", "Sensor"]


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


SENSORS: tuple[Callable[[FloatArray, int, float, float, float, float], Distorted], ...] = (
    _coordinates,
    _azimuth,
    _elevation,
    _inverse_range,
)
"""As `Distortion.distort`, by `Sensor`."""
