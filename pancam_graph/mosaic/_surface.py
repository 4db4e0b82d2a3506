"""The surface that the landmarks of a stop span, as the inverse range in every direction from one point."""

from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import Solution
from pancam_graph.mosaic._placed import View

__all__ = ["FAR_M", "Surface", "directions", "surface_of_stop"]

FAR_M = 1e5
"""Range of the sky and of everything beyond the last landmark, metres."""

_CELL_DEG = 1.0
_COLUMNS = 360
_ROWS = 181
_OBSERVED_PX = 0.15
"""Standard deviation of a landmark's parallax, pixels."""
_ROBUST_PX = 0.5
"""Residual of a landmark's parallax at which its weight is halved."""
_RELIEF_PER_CELL = 0.1
"""Standard deviation of the change of range from one cell to the next, as a share of it, besides the
plane's."""
_LEAST_INVERSE_RANGE = 0.01
"""Per metre; the scale of that share where the plane is far away or above the horizon."""
_FADE_CELLS = 10.0
"""Distance from the last landmark over which the surface returns to the plane."""
_PLANE_SIGMA = 0.05
"""Standard deviations of the priors of the plane: its slopes about 0, and its distance as a share of the
nominal one."""
_NEIGHBOURS = 8
_ALIKE = 0.15
"""Share by which the ranges of two neighbours may differ from a landmark's own at the most."""
_SPIKE = 2.0
"""How many times nearer or farther a cell may be than the median of its surroundings."""
_ROUNDS = 5
_MOST_GRADIENTS = 50
_FARTHEST_GROUND_M = 300.0
"""Inverse range below which ground is not told from sky."""
_HIDDEN = 1.5
"""A place is hidden if the surface in its direction is nearer or farther than it by this factor."""


def directions(azimuth_rad: FloatArray, elevation_rad: FloatArray) -> FloatArray:
    """Unit vectors (..., 3) of the world: azimuth anticlockwise from x, elevation up from the horizontal."""
    azimuth, elevation = np.broadcast_arrays(azimuth_rad, elevation_rad)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """The inverse range of the terrain in every direction from `origin_m`, a point of the world."""

    origin_m: FloatArray
    """(3,) world point that directions start from."""
    plane: FloatArray
    """(3,) per metre: the ground plane is where `plane @ (point - origin) = 1`."""
    relief: FloatArray
    """(181, 360) per metre, added to the plane's inverse range; a row for each degree of elevation from the
    nadir up, a column for each degree of azimuth from 0."""

    def inverse_range(self, direction: FloatArray) -> FloatArray:
        """Inverse ranges (n,) per metre along unit directions (n, 3), 1 / FAR_M at least."""
        relief = _interpolation(direction) @ self.relief.ravel()
        return np.asarray(np.maximum(_plane_inverse_range(self.plane, direction) + relief, 1 / FAR_M))

    def points_m(self, direction: FloatArray) -> FloatArray:
        """World points (n, 3) of the surface along unit directions (n, 3) from the origin."""
        return np.asarray(self.origin_m + direction / self.inverse_range(direction)[:, None])

    def ground_m(self, xy_m: FloatArray) -> FloatArray:
        """World points (n, 3) of the surface at places (n, 2), world x and y minus the origin's.

        NaN where the place is not seen from the origin: behind terrain that rises in front of it, and farther
        than the surface reaches.
        """
        azimuth = np.deg2rad(_CELL_DEG) * np.arange(_COLUMNS)
        elevation = np.deg2rad(np.linspace(-89.9, 89.9, 4 * _ROWS))
        ray = directions(azimuth[:, None], elevation[None, :])
        inverse = self.inverse_range(ray.reshape(-1, 3)).reshape(ray.shape[:2])
        inverse = np.maximum(inverse, 1 / _FARTHEST_GROUND_M)
        out_m = np.log(np.maximum.accumulate(np.cos(elevation) / inverse, axis=1))
        up_m = np.sin(elevation) / inverse
        # Pixels of a panorama are about even in the logarithm of the distance.
        reach = np.log(np.maximum(np.hypot(xy_m[:, 0], xy_m[:, 1]), 1e-3))
        knots = np.linspace(reach.min(), reach.max() + 1e-9, 4 * _ROWS)
        profile = np.stack([np.interp(knots, o, u) for o, u in zip(out_m, up_m, strict=True)])
        column = np.rad2deg(np.arctan2(xy_m[:, 1], xy_m[:, 0])) / _CELL_DEG
        row = (reach - knots[0]) / (knots[1] - knots[0])
        at = _bilinear(column, row, columns=_COLUMNS, rows=len(knots))
        point = np.column_stack([xy_m, at @ profile.T.ravel()])
        range_m = np.linalg.norm(point, axis=1)
        share = range_m * self.inverse_range(point / range_m[:, None])
        point[(share < 1 / _HIDDEN) | (share > _HIDDEN)] = np.nan
        return np.asarray(self.origin_m + point)


def surface_of_stop(solution: Solution, stop: int, origin_m: FloatArray, view: View) -> Surface:
    """The surface that a view's landmarks span around `origin_m` (3,), a point near the stop's cameras.

    Taken are landmarks with used observations in images of the stop. The surface is the ground plane that
    fits them, and relief on it: the smoothest inverse ranges that agree with the landmarks, each weighted by
    how far its inverse range moves it in the images that saw it (a range that parallax does not determine
    does not matter to a mosaic either), robustly. Away from landmarks the relief fades to the plane, and
    above the plane's horizon to a far sphere. Without landmarks it is the rig's nominal ground.
    """
    rows, weight = _parallax_weights(solution, stop, origin_m, view)
    to_point = view.landmarks_m[rows] - origin_m
    inverse = 1 / np.linalg.norm(to_point, axis=1)
    ray = to_point * inverse[:, None]
    sound = _supported(ray, inverse, weight)
    inverse, ray, weight, rows = inverse[sound], ray[sound], weight[sound], rows[sound]
    plane = _fit_plane(ray, inverse, weight, _nominal_height_m(solution, stop, origin_m))
    base = _plane_inverse_range(plane, ray)
    at = _interpolation(ray)
    smooth = _smoothness(plane)
    relief = np.zeros(_ROWS * _COLUMNS)
    # All landmarks have full weight at first: their distance from the plane is relief, not error.
    robust = np.ones(len(rows))
    first = None
    for _ in range(_ROUNDS if len(rows) else 0):
        data = scipy.sparse.diags(weight * robust)
        system = (at.T @ data @ at + smooth).tocsc()
        right = at.T @ (weight * robust * (inverse - base))
        if first is None:
            first = scipy.sparse.linalg.splu(
                system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
            )
            relief = first.solve(right)
        else:  # weights change little: the first factorisation is a good preconditioner
            solver = scipy.sparse.linalg.LinearOperator(system.shape, matvec=first.solve, dtype=np.float64)
            relief, _ = scipy.sparse.linalg.cg(
                system, right, x0=relief, rtol=1e-6, maxiter=_MOST_GRADIENTS, M=solver
            )
        robust = _robust(weight, inverse - base - at @ relief)
    return Surface(
        origin_m=origin_m, plane=plane, relief=_without_spikes(plane, relief.reshape(_ROWS, _COLUMNS))
    )


def _supported(ray: FloatArray, inverse: FloatArray, weight: FloatArray) -> BoolArray:
    """Which landmarks (n,) have two neighbours of about their range, as far as parallax determines it.

    A landmark without is most often a wrong match: patterns of the rover's deck repeat.
    """
    if len(ray) <= _NEIGHBOURS:
        return np.ones(len(ray), dtype=bool)
    near = np.asarray(scipy.spatial.cKDTree(ray).query(ray, k=_NEIGHBOURS + 1)[1])[:, 1:]
    apart = np.abs(inverse[near] - inverse[:, None])
    noise = np.sqrt(1 / np.maximum(weight, 1e-12))
    noise = np.hypot(noise[:, None], noise[near])
    alike = (apart < _ALIKE * inverse[:, None]) | (apart < 3 * noise)
    return np.asarray(np.count_nonzero(alike, axis=1) >= 2)


def _without_spikes(plane: FloatArray, relief: FloatArray) -> FloatArray:
    """Relief without single cells that are far nearer or farther than all around: most often wrong matches.

    A cell that is too far would leave out all ground before it in the mosaic from above.
    """
    elevation, azimuth = np.deg2rad(np.arange(_ROWS) - 90.0), np.deg2rad(np.arange(_COLUMNS))
    ray = directions(azimuth[None, :], elevation[:, None])
    base = _plane_inverse_range(plane, ray.reshape(-1, 3)).reshape(relief.shape)
    inverse = np.maximum(base + relief, _LEAST_INVERSE_RANGE)
    padded = np.pad(np.pad(inverse, ((0, 0), (1, 1)), "wrap"), ((1, 1), (0, 0)), "edge")
    around = scipy.ndimage.median_filter(padded, size=3)[1:-1, 1:-1]
    spike = (inverse > _SPIKE * around) | (inverse * _SPIKE < around)
    return np.asarray(np.where(spike, around - base, relief))


def _nominal_height_m(solution: Solution, stop: int, origin_m: FloatArray) -> float:
    """Height of the origin above the ground as the rig states it."""
    mast_z = float(solution.final.world_T_mast[stop].translation()[2])
    return max(float(origin_m[2]) - mast_z + solution.traverse.rig.mast_height_m, 0.1)


def _parallax_weights(
    solution: Solution, stop: int, origin_m: FloatArray, view: View
) -> tuple[IntArray, FloatArray]:
    """Rows of the landmarks that images of a stop saw, and the information on their inverse ranges, m^2."""
    traverse, observations = solution.traverse, solution.traverse.observations
    n = len(solution.landmark_track)
    none = np.zeros(0, dtype=np.int64), np.zeros(0)
    if observations is None or n == 0:
        return none
    order = np.argsort(solution.landmark_track, kind="stable")
    known = solution.landmark_track[order]
    at = np.minimum(np.searchsorted(known, observations.track), n - 1)
    landmark = order[at]
    usable = solution.used & (known[at] == observations.track)
    usable &= np.isfinite(view.landmarks_m[landmark]).all(axis=1)
    here = np.zeros(n, dtype=bool)
    here[landmark[usable & (traverse.image_stop[observations.image] == stop)]] = True
    usable &= here[landmark]

    count, slope, square = np.zeros(n), np.zeros((n, 2)), np.zeros(n)
    rotation, centre = view.world_R_camera, view.world_t_camera
    for image in np.unique(observations.image[usable]).tolist():
        seen = landmark[usable & (observations.image == image)]
        points = view.landmarks_m[seen]
        camera = traverse.rig.eyes[int(traverse.image_eye[image])].camera
        _, d_uv, valid = camera.project_with_jacobian((points - centre[image]) @ rotation[image])
        to_point = points - origin_m
        # By the inverse range rho: d(origin + ray / rho) = -ray / rho^2 = -to_point * range.
        d_point = -to_point * np.linalg.norm(to_point, axis=1)[:, None]
        moved = np.where(valid[:, None], np.einsum("nij,nj->ni", d_uv, d_point @ rotation[image]), 0.0)
        count[seen] += valid
        slope[seen] += moved
        square[seen] += np.einsum("ni,ni->n", moved, moved)
    rows = np.flatnonzero(here & (count >= 2))
    if not len(rows):
        return none
    # A motion that is the same in all images is a shift across the line of sight, not parallax.
    spread = square[rows] - np.einsum("ni,ni->n", slope[rows], slope[rows]) / count[rows]
    return rows, np.maximum(spread, 0.0) / _OBSERVED_PX**2


def _robust(weight: FloatArray, miss: FloatArray) -> FloatArray:
    """Cauchy weights (n,) of inverse ranges with residuals `miss` (n,)."""
    return np.asarray(1 / (1 + weight * miss**2 * (_OBSERVED_PX / _ROBUST_PX) ** 2))


def _fit_plane(ray: FloatArray, inverse: FloatArray, weight: FloatArray, height_m: float) -> FloatArray:
    """The plane (3,) that most landmarks are near.

    Residuals are shares of the range: in pixels of parallax the nearest landmarks would decide alone.
    Landmarks without parallax have little weight. Those above the plane's horizon have none, as hills would
    pull the plane down.
    """
    nominal = np.array([0.0, 0.0, -1 / height_m])
    information = np.eye(3) * (height_m / _PLANE_SIGMA) ** 2
    share = np.maximum(inverse, _LEAST_INVERSE_RANGE)
    trusted = 1 / (0.1**2 * share**2 + 1 / np.maximum(weight, 1e-12))
    plane, robust = nominal, np.ones(len(ray))
    for _ in range(4 * _ROUNDS):
        w = np.where(ray @ plane > 0, trusted * robust, 0.0)
        normal = information + ray.T @ (w[:, None] * ray)
        plane = np.linalg.solve(normal, information @ nominal + ray.T @ (w * inverse))
        miss = inverse - _plane_inverse_range(plane, ray)
        robust = 1 / (1 + trusted * miss**2)
    return plane


def _plane_inverse_range(plane: FloatArray, direction: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(direction @ plane, 0.0))


def _interpolation(direction: FloatArray) -> "scipy.sparse.csr_array":
    """Matrix (n, rows * columns) that reads the relief along unit directions (n, 3)."""
    azimuth = np.rad2deg(np.arctan2(direction[:, 1], direction[:, 0])) / _CELL_DEG
    elevation = np.rad2deg(np.arcsin(np.clip(direction[:, 2], -1.0, 1.0))) / _CELL_DEG
    return _bilinear(azimuth, elevation + 90.0 / _CELL_DEG, columns=_COLUMNS, rows=_ROWS)


def _bilinear(column: FloatArray, row: FloatArray, *, columns: int, rows: int) -> "scipy.sparse.csr_array":
    """Matrix that interpolates a grid whose columns go round, at (n,) columns and rows."""
    left, low = np.floor(column).astype(np.int64), np.clip(np.floor(row).astype(np.int64), 0, rows - 2)
    right, up = column - left, np.clip(row - low, 0.0, 1.0)
    n = np.arange(len(column))
    cells, weights = [], []
    for j, across in ((0, 1 - right), (1, right)):
        for i, along in ((0, 1 - up), (1, up)):
            cells.append((low + i) * columns + (left + j) % columns)
            weights.append(across * along)
    at = (np.concatenate(weights), (np.tile(n, 4), np.concatenate(cells)))
    return scipy.sparse.csr_array(at, shape=(len(column), rows * columns))


def _smoothness(plane: FloatArray) -> "scipy.sparse.csr_array":
    """Matrix of the prior of the relief.

    It holds the relief itself near 0, and changes from cell to cell, as shares of the plane's inverse range.
    """
    elevation = np.deg2rad(_CELL_DEG * np.arange(_ROWS) - 90.0)
    azimuth = np.deg2rad(_CELL_DEG) * np.arange(_COLUMNS)
    base = _plane_inverse_range(plane, directions(azimuth[None, :], elevation[:, None]).reshape(-1, 3))
    scale = 1 / (_RELIEF_PER_CELL * np.maximum(base, _LEAST_INVERSE_RANGE))
    number = np.arange(_ROWS * _COLUMNS).reshape(_ROWS, _COLUMNS)
    # Near nadir and zenith cells are narrow, so that neighbours differ less.
    narrow = 1 / np.maximum(np.cos(elevation), np.sin(np.deg2rad(_CELL_DEG)))
    parts = []
    for a, b, stiff in (
        (number.ravel(), np.roll(number, -1, axis=1).ravel(), np.repeat(narrow, _COLUMNS)),
        (number[:-1].ravel(), number[1:].ravel(), np.ones((_ROWS - 1) * _COLUMNS)),
    ):
        weight = stiff * 0.5 * (scale[a] + scale[b])
        edge = np.arange(len(a))
        ends = (np.concatenate([weight, -weight]), (np.tile(edge, 2), np.concatenate([a, b])))
        parts.append(scipy.sparse.csr_array(ends, shape=(len(a), number.size)))
    change = scipy.sparse.vstack(parts)
    return scipy.sparse.csr_array(change.T @ change + scipy.sparse.diags((scale / _FADE_CELLS) ** 2))
