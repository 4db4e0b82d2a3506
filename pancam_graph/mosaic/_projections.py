"""Where a mosaic's pixels are in the world: around the horizon, and seen from above."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.mosaic._surface import Surface, directions

__all__ = ["Cylinder", "Ground", "Projection"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Cylinder:
    """A panorama whose columns are even in azimuth and whose rows are even in elevation.

    Pixel (0, 0) is the centre of the top left one. Azimuth is that of the world: anticlockwise from x, seen
    from above, so that it falls to the right; elevation is upwards from the horizontal.
    """

    origin_m: FloatArray
    """(3,) world point that directions start from."""
    width_px: int
    height_px: int
    px_per_degree: float
    left_deg: float
    """Azimuth of the first column."""
    top_deg: float
    """Elevation of the first row."""

    @property
    def closed(self) -> bool:
        """Whether the last column is followed by the first."""
        return abs(self.width_px / self.px_per_degree - 360) < 1e-6

    def azimuth_deg(self, column_px: FloatArray) -> FloatArray:
        """Azimuths of columns."""
        return np.asarray(self.left_deg - column_px / self.px_per_degree)

    def elevation_deg(self, row_px: FloatArray) -> FloatArray:
        """Elevations of rows."""
        return np.asarray(self.top_deg - row_px / self.px_per_degree)

    def points_m(self, surface: Surface, column_px: FloatArray, row_px: FloatArray) -> FloatArray:
        """World points (n, 3) of the surface at pixels, columns (n,) and rows (n,)."""
        ray = directions(np.deg2rad(self.azimuth_deg(column_px)), np.deg2rad(self.elevation_deg(row_px)))
        return surface.points_m(ray)

    def pixels(self, points_m: FloatArray) -> FloatArray:
        """Pixels (n, 2), column and row, of world points (n, 3); columns of one turn from the first on."""
        d = points_m - self.origin_m
        azimuth = np.rad2deg(np.arctan2(d[:, 1], d[:, 0]))
        elevation = np.rad2deg(np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1])))
        # The first column begins half a pixel before its centre.
        half = 0.5 / self.px_per_degree
        column = ((self.left_deg - azimuth + half) % 360 - half) * self.px_per_degree
        return np.column_stack([column, (self.top_deg - elevation) * self.px_per_degree])


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """A square of ground seen straight from above: world x to the right, world y up."""

    origin_m: FloatArray
    """(3,) world point above its middle, from which the surface was seen."""
    width_px: int
    height_px: int
    m_per_px: float
    left_m: float
    """World x of the first column, minus that of the origin."""
    top_m: float
    """World y of the first row, minus that of the origin."""

    @property
    def closed(self) -> bool:
        """False: the last column is not followed by the first."""
        return False

    @staticmethod
    def around(origin_m: FloatArray, radius_m: float, m_per_px: float) -> "Ground":
        """The square about a point (3,)."""
        side = max(2, round(2 * radius_m / m_per_px))
        corner_m = 0.5 * (side - 1) * m_per_px
        return Ground(
            origin_m=origin_m,
            width_px=side,
            height_px=side,
            m_per_px=m_per_px,
            left_m=-corner_m,
            top_m=corner_m,
        )

    def points_m(self, surface: Surface, column_px: FloatArray, row_px: FloatArray) -> FloatArray:
        """World points (n, 3) of the surface at columns (n,) and rows (n,); NaN where it is hidden."""
        xy_m = np.column_stack([self.left_m + column_px * self.m_per_px, self.top_m - row_px * self.m_per_px])
        return surface.ground_m(xy_m)

    def pixels(self, points_m: FloatArray) -> FloatArray:
        """Pixels (n, 2), column and row, of world points (n, 3)."""
        d = points_m - self.origin_m
        return np.column_stack([d[:, 0] - self.left_m, self.top_m - d[:, 1]]) / self.m_per_px


Projection = Cylinder | Ground
