"""Ground to simulate over: rolling, with rocks, and a ridge on the horizon, as one height field."""

from dataclasses import dataclass

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray

__all__ = ["GroundModel"]

_WAVES = 12
_WAVELENGTHS_M = (4.0, 400.0)
_ROCK_CELL_M = 1.0
_ROCK_RADIUS_M = (0.08, 0.45)
_ROCK_ASPECT = 0.7  # height of a rock over its radius
_ROCK_HEIGHT_M = _ROCK_ASPECT * _ROCK_RADIUS_M[1]  # of the highest
_NEAREST_M = 0.3
_STRIDE = 1.04  # ratio of successive distances along a ray
_FARTHEST = 2.5  # where a ray is given up, over the distance of the ridge
_BISECTIONS = 16
_RIDGE_SIZE = 0.06  # height of the ridge over its distance: 3.4 degrees
_RIDGE_WIDTH = 0.25  # half width of the ridge over its distance


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundModel:
    """A height field over the world's x and y, in metres, z up. Same numbers, same ground."""

    wave_rad_m: FloatArray
    """(waves, 2) wave vectors of the rolling ground, radians per metre."""
    wave_height_m: FloatArray
    """(waves,) amplitude of each wave, metres."""
    wave_phase_rad: FloatArray
    """(waves,) phase of each wave at the origin, radians."""
    rocks: float
    """Share of square metres with a rock on them."""
    rock_key: int
    """Seed of the rocks: where they lie, and how large they are."""
    ridge_centre_m: FloatArray
    """(2,) x and y of the middle of the basin that the ridge surrounds."""
    ridge_distance_m: float
    """Mean distance of the crest from there."""
    ridge_phase_rad: FloatArray
    """(4,) phases of the crest's line and height around the basin."""

    @staticmethod
    def random(
        rng: np.random.Generator,
        *,
        slope_rad: float,
        rocks: float,
        ridge_centre_m: FloatArray,
        ridge_distance_m: float,
    ) -> "GroundModel":
        """Draw a terrain whose rolling ground has the RMS slope `slope_rad` along either axis."""
        length = np.geomspace(*_WAVELENGTHS_M, _WAVES)
        towards = rng.uniform(0, 2 * np.pi, _WAVES)
        # Each of n waves has the mean square slope (2 pi a / length)^2 / 4 along an axis.
        height = length * np.tan(slope_rad) / (np.pi * np.sqrt(_WAVES))
        wave = 2 * np.pi / length[:, None] * np.column_stack([np.cos(towards), np.sin(towards)])
        return GroundModel(
            wave_rad_m=wave,
            wave_height_m=height,
            wave_phase_rad=rng.uniform(0, 2 * np.pi, _WAVES),
            rocks=rocks,
            rock_key=int(rng.integers(2**62)),
            ridge_centre_m=ridge_centre_m,
            ridge_distance_m=ridge_distance_m,
            ridge_phase_rad=rng.uniform(0, 2 * np.pi, 4),
        )

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Height of the surface (n,) at x and y (n, 2)."""
        return self.ground_m(xy_m) + self._rock_m(xy_m) + self._ridge_m(xy_m)

    def ground_m(self, xy_m: FloatArray) -> FloatArray:
        """Height of the rolling ground alone (n,), without rocks and ridge, at x and y (n, 2)."""
        return np.asarray(
            np.sin(xy_m @ self.wave_rad_m.T + self.wave_phase_rad) @ self.wave_height_m, dtype=float
        )

    def ground_slope(self, xy_m: FloatArray) -> FloatArray:
        """Rise of the rolling ground per metre of x and of y, (n, 2), at x and y (n, 2)."""
        turn = np.cos(xy_m @ self.wave_rad_m.T + self.wave_phase_rad) * self.wave_height_m
        return np.asarray(turn @ self.wave_rad_m, dtype=float)

    def _rock_m(self, xy_m: FloatArray) -> FloatArray:
        # At most one rock a cell, wholly inside it, drawn by hashing the cell: endless and never stored.
        cell = np.floor(xy_m / _ROCK_CELL_M)
        chance, size, x, y = _hash_uniform(cell, self.rock_key)
        radius = np.minimum(_ROCK_RADIUS_M[0] * (1 - size) ** -0.4, _ROCK_RADIUS_M[1])
        centre = radius[:, None] + (_ROCK_CELL_M - 2 * radius[:, None]) * np.column_stack([x, y])
        away = np.sum((xy_m - cell * _ROCK_CELL_M - centre) ** 2, axis=1) / radius**2
        dome = _ROCK_ASPECT * radius * np.sqrt(np.maximum(0.0, 1 - away))
        return np.where(chance < self.rocks, dome, 0.0)

    def _ridge_m(self, xy_m: FloatArray) -> FloatArray:
        out = np.zeros(len(xy_m))
        d = xy_m - self.ridge_centre_m
        distance = np.hypot(d[:, 0], d[:, 1])
        far = np.flatnonzero(distance > 0.05 * self.ridge_distance_m)  # nearer by, a millionth of its height
        if len(far) == 0:
            return out
        azimuth = np.arctan2(d[far, 1], d[far, 0])
        p = self.ridge_phase_rad
        crest = self.ridge_distance_m * (
            1 + 0.25 * np.sin(2 * azimuth + p[0]) + 0.1 * np.sin(5 * azimuth + p[1])
        )
        height = (
            _RIDGE_SIZE * crest * (1 + 0.4 * np.sin(3 * azimuth + p[2]) + 0.2 * np.sin(17 * azimuth + p[3]))
        )
        out[far] = height * np.exp(-(((distance[far] - crest) / (_RIDGE_WIDTH * crest)) ** 2))
        return out

    def cast(
        self, origin_m: FloatArray, direction: FloatArray, *, farthest_m: float = np.inf
    ) -> tuple[FloatArray, BoolArray]:
        """Where rays from origins (n, 3) along unit directions (n, 3) meet the surface.

        Returns points (n, 3), whose z is the surface's at their x and y, and which rays hit (n,): not
        those that end in the sky, start below ground or meet it farther than `farthest_m` from their
        origin. Features smaller than 4 % of their distance may be passed by.
        """
        n = len(origin_m)
        highest = float(self.wave_height_m.sum()) + _ROCK_HEIGHT_M + 2.5 * _RIDGE_SIZE * self.ridge_distance_m
        end_m = min(farthest_m, _FARTHEST * self.ridge_distance_m)
        before, after = np.zeros(n), np.full(n, _NEAREST_M)
        hit = np.zeros(n, dtype=bool)
        active = np.arange(n)
        while len(active):
            at = origin_m[active] + after[active, None] * direction[active]
            over_ground = at[:, 2] - self.ground_m(at[:, :2]) - self._ridge_m(at[:, :2])
            clearance = over_ground.copy()
            near = np.flatnonzero((over_ground > 0) & (over_ground < _ROCK_HEIGHT_M))
            clearance[near] -= self._rock_m(at[near, :2])
            below = clearance < 0
            hit[active[below]] = before[active[below]] > 0
            lost = (at[:, 2] > highest) & (direction[active, 2] > 0)
            onward = ~below & ~lost & (after[active] < end_m)
            active = active[onward]
            before[active] = after[active]
            # Well above ground, no slope up to 1 can be reached within half the height over its rocks.
            free = 0.5 * (over_ground[onward] - _ROCK_HEIGHT_M)
            after[active] += np.maximum((_STRIDE - 1) * after[active], free)
        rows = np.flatnonzero(hit)
        low, high = before[rows], after[rows]
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            at = origin_m[rows] + middle[:, None] * direction[rows]
            below = at[:, 2] < self.height_m(at[:, :2])
            low, high = np.where(below, low, middle), np.where(below, middle, high)
        points = origin_m + np.zeros((n, 1))
        points[rows] = origin_m[rows] + low[:, None] * direction[rows]
        points[rows, 2] = self.height_m(points[rows, :2])
        hit[rows] = np.linalg.norm(points[rows] - origin_m[rows], axis=1) <= farthest_m
        return points, hit


def _hash_uniform(cell: FloatArray, key: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Four numbers in [0, 1), each (n,), that depend on nothing but the cell (n, 2) and the key.

    Source: the finaliser of splitmix64 (Steele, Lea and Flood, Fast splittable pseudorandom number
    generators, 2014).
    """
    i, j = (cell[:, k].astype(np.int64).astype(np.uint64) for k in (0, 1))
    x = i * np.uint64(0x9E3779B97F4A7C15) ^ j * np.uint64(0xC2B2AE3D27D4EB4F) ^ np.uint64(key)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    a, b, c, d = (((x >> np.uint64(16 * k)) & np.uint64(0xFFFF)).astype(float) / 65536 for k in range(4))
    return a, b, c, d
