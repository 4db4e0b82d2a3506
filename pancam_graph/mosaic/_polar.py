"""The panorama seen from above its mast: the nadir in the middle, the horizon a circle, north up."""

import cv2
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.charts import Axis, Picture, framed
from pancam_graph.mosaic._draw import EMPTY, draw_compass
from pancam_graph.mosaic._make import Mosaic
from pancam_graph.mosaic._placed import Pointing
from pancam_graph.mosaic._projections import Cylinder
from pancam_graph.mosaic._resampled import Resampled

__all__ = ["goes_half_round", "polar_view"]

_SIDE_PX = 2000
_LEAST_TURN_DEG = 180.0
_MARGIN_PX = 30


def goes_half_round(cylinder: Cylinder) -> bool:
    """Whether a panorama covers half of the horizon, so that a view from the pole is not mostly empty."""
    return cylinder.width_px / cylinder.px_per_degree >= _LEAST_TURN_DEG


def directions_deg(side_px: int, px_per_degree: float, up_deg: float) -> tuple[FloatArray, FloatArray]:
    """Azimuth and elevation (rows, columns) at pixels of a square whose middle is the nadir.

    Distance from the middle is the angle from the nadir (azimuthal equidistant: Snyder 1987, Map projections,
    section 25). `up_deg` is the azimuth that is up, anticlockwise from the world's x axis; azimuths fall
    clockwise, as on a map.
    """
    offset = (np.arange(side_px) - 0.5 * (side_px - 1)) / px_per_degree
    right, down = np.meshgrid(offset, offset)
    clockwise = np.rad2deg(np.arctan2(right, -down))
    return np.asarray(up_deg - clockwise), np.asarray(np.hypot(right, down) - 90.0)


def polar_view(
    mosaic: Mosaic, pointing: Pointing, title: str, side_px: int = _SIDE_PX, *, north_deg: float | None
) -> Picture:
    """A panorama as a disc, in colour (blue, green, red), with circles of elevation and lines of azimuth.

    Up is north where `north_deg`, its azimuth anticlockwise from the world's x axis, is known, and azimuths
    count clockwise from it; else up is the world's y axis, and azimuths count anticlockwise from x.
    """
    cylinder = mosaic.projection
    assert isinstance(cylinder, Cylinder)  # only a panorama has a horizon
    reach_deg = cylinder.top_deg + 90.0
    scale = min((0.5 * side_px - _MARGIN_PX) / reach_deg, cylinder.px_per_degree)
    side = 2 * int(np.ceil(reach_deg * scale + _MARGIN_PX))
    azimuth, elevation = directions_deg(side, scale, 90.0 if north_deg is None else north_deg)
    grey, there = Resampled(cylinder, mosaic.pictures[pointing], scale).at(azimuth, elevation)
    shown = np.where(there, np.clip(np.rint(grey), 1, 255), EMPTY).astype(np.uint8)
    picture: Picture = np.repeat(shown[..., None], 3, axis=-1)
    middle = np.array([0.5 * (side - 1), 0.5 * (side - 1)])
    rings = [(e + 90.0, f"{e} deg") for e in range(-60, 90, 30) if e < cylinder.top_deg]
    # Azimuths stand at the rim.
    circles = [*((radius * scale, label) for radius, label in rings), (reach_deg * scale, "")]
    draw_compass(picture, middle, circles, None if north_deg is None else 90.0)
    if north_deg is not None:
        cv2.arrowedLine(picture, (side - 60, 110), (side - 60, 40), (0, 94, 213), 2, cv2.LINE_AA, 0, 0.3)
    way = (
        "anticlockwise from the world's x axis" if north_deg is None else "clockwise from north, which is up"
    )
    none = Axis([], [])
    return framed(picture, none, none, (f"lines: azimuth, degrees {way}; circles: elevation", ""), title)
