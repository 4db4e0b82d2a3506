"""A place on a planet: where the world's origin lies, and where north is.

Bodies are ellipsoids of revolution: Mars and Moon as the IAU working group has them (Archinal et al. 2018),
Earth as WGS 84. The world's z is the ellipsoid's normal at its origin. Latitudes are those that maps of a
body have: planetocentric on Mars and Moon, geodetic on Earth. Longitudes count east.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, rz

__all__ = ["BODIES", "Body", "BodyShape", "Site", "shape_of"]

Body = Literal["Mars", "Moon", "Earth"]
_ROUNDS = 8
"""Rounds of a latitude, each a hundred times as near as the one before on the flattest of the bodies."""


@dataclass(frozen=True)
class BodyShape:
    """An ellipsoid of revolution, and how maps of the body are named."""

    equator_m: float
    """Radius of its equator."""
    pole_m: float
    """Half its axis of rotation."""
    map_radius_m: float
    """Radius of the sphere that maps of it are drawn on; of Earth, the equator's."""
    map_code: str
    """Authority and code of the coordinate system of latitudes and longitudes of its maps."""
    is_geodetic: bool
    """Whether maps have geodetic latitudes; else planetocentric ones."""

    @property
    def e2(self) -> float:
        """Square of the first eccentricity."""
        return 1.0 - (self.pole_m / self.equator_m) ** 2


_SHAPES: dict[str, BodyShape] = {
    "Mars": BodyShape(3396190.0, 3376200.0, 3396190.0, "IAU_2015:49900", is_geodetic=False),
    "Moon": BodyShape(1737400.0, 1737400.0, 1737400.0, "IAU_2015:30100", is_geodetic=False),
    "Earth": BodyShape(6378137.0, 6356752.314245, 6378137.0, "EPSG:4326", is_geodetic=True),
}
BODIES: tuple[Body, ...] = get_args(Body)
"""Names of the bodies."""


def shape_of(body: Body) -> BodyShape:
    """The shape of a body."""
    return _SHAPES[body]


@dataclass(frozen=True, kw_only=True)
class Site:
    """Where the world's origin is on a body. The constructor raises InputError for numbers out of range."""

    body: Body
    latitude_deg: float
    """Planetocentric on Mars and Moon, geodetic on Earth; north is positive."""
    longitude_deg: float
    """East is positive; from -180 to 360."""
    height_m: float
    """Above the surface that heights of the body's maps count from; taken for that of the ellipsoid, which is
    within 3 km of it: 1 m in 1 km."""
    north_rad: float
    """Direction of north in the world, anticlockwise from its x axis: pi / 2 where x is east, y is north."""

    def __post_init__(self) -> None:
        """Check names and numbers."""
        if self.body not in BODIES:
            raise InputError(f"body: expected one of {', '.join(BODIES)}, found {self.body!r}")
        for name, low, high in (
            ("latitude_deg", -89.999, 89.999),
            ("longitude_deg", -180.0, 360.0),
            ("height_m", -1e5, 1e5),
            ("north_rad", -10.0, 10.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name}: expected a number from {low:g} to {high:g}, found {value}")

    @property
    def shape(self) -> BodyShape:
        """The shape of its body."""
        return _SHAPES[self.body]

    @cached_property
    def body_frame(self) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and origin (3,) of the world in the body's own frame, metres."""
        centre, normal = self._fixed(
            np.array([self.latitude_deg]), np.array([self.longitude_deg]), np.array([self.height_m])
        )
        up = normal[0]
        east = np.array(
            [-np.sin(np.radians(self.longitude_deg)), np.cos(np.radians(self.longitude_deg)), 0.0]
        )
        level = np.column_stack([east, np.cross(up, east), up])
        return level @ self.level_R_world, centre[0]

    def _fixed(
        self, latitude_deg: FloatArray, longitude_deg: FloatArray, height_m: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Places (n, 3) in the body's frame, and the ellipsoid's normals there."""
        shape, told, longitude = self.shape, np.radians(latitude_deg), np.radians(longitude_deg)
        latitude = told  # geodetic
        for _ in range(0 if shape.is_geodetic else _ROUNDS):
            radius = shape.equator_m / np.sqrt(1 - shape.e2 * np.sin(latitude) ** 2)
            flat = (radius * (1 - shape.e2) + height_m) / (radius + height_m)
            latitude = np.arctan2(np.sin(told), np.cos(told) * flat)
        radius = shape.equator_m / np.sqrt(1 - shape.e2 * np.sin(latitude) ** 2)
        normal = np.column_stack(
            [
                np.cos(latitude) * np.cos(longitude),
                np.cos(latitude) * np.sin(longitude),
                np.sin(latitude),
            ]
        )
        place = normal * (radius + height_m)[:, None]
        place[:, 2] -= shape.e2 * radius * np.sin(latitude)
        return place, normal

    def geographic(self, points_m: FloatArray) -> FloatArray:
        """Latitudes and longitudes, degrees, and heights, metres (n, 3), of points (n, 3) of the world.

        Longitudes are within 180 degrees of the site's. NaN stays NaN.
        """
        rotation, origin = self.body_frame
        shape, place = self.shape, points_m @ rotation.T + origin
        across = np.hypot(place[:, 0], place[:, 1])
        latitude = np.arctan2(place[:, 2], across * (1 - shape.e2))
        for _ in range(_ROUNDS):
            radius = shape.equator_m / np.sqrt(1 - shape.e2 * np.sin(latitude) ** 2)
            latitude = np.arctan2(place[:, 2] + shape.e2 * radius * np.sin(latitude), across)
        radius = shape.equator_m / np.sqrt(1 - shape.e2 * np.sin(latitude) ** 2)
        sine, cosine = np.sin(latitude), np.cos(latitude)
        height = across * cosine + (place[:, 2] + shape.e2 * radius * sine) * sine - radius
        told = latitude if shape.is_geodetic else np.arctan2(place[:, 2], across)
        longitude = np.degrees(np.arctan2(place[:, 1], place[:, 0]))
        turns = np.round((longitude - self.longitude_deg) / 360.0)
        return np.column_stack([np.degrees(told), longitude - 360.0 * turns, height])

    def points_m(self, geographic: FloatArray) -> FloatArray:
        """Points (n, 3) of the world at latitudes, longitudes and heights (n, 3); inverse of `geographic`."""
        rotation, origin = self.body_frame
        place, _ = self._fixed(geographic[:, 0], geographic[:, 1], geographic[:, 2])
        return np.asarray((place - origin) @ rotation)

    @property
    def level_R_world(self) -> FloatArray:
        """(3, 3) turn about z that takes the world's axes to east, north and up."""
        return rz(np.pi / 2 - self.north_rad)

    def azimuth_deg(self, heading_rad: float) -> float:
        """Azimuth, clockwise from north, 0 to 360, of a direction anticlockwise from the world's x axis."""
        return float(np.degrees(self.north_rad - heading_rad) % 360.0) % 360.0

    @property
    def map_scale(self) -> float:
        """Metres of the world over metres on the sphere of the body's maps, at the site."""
        if self.shape.is_geodetic:
            return 1.0 + self.height_m / self.shape.equator_m
        return float(np.linalg.norm(self.body_frame[1])) / self.shape.map_radius_m
