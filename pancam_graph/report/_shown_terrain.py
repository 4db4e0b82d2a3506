"""The landmarks that are shown, and the box that holds them: far ones would shrink all others to a dot."""

from dataclasses import dataclass

import numpy as np
import scipy

from pancam_graph.base.geometry import FloatArray, IntArray, pose_arrays
from pancam_graph.data import Solution

__all__ = ["ShownTerrain", "landmark_residuals", "shown_terrain"]

_FAR_WORLD_M = 1e4
_NOWHERE_M = 1e15
_LEAST_EXTENT_M = 2.0
_PAD = 0.08


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownTerrain:
    """The landmarks inside the box that the scene and the map show, relative to an origin."""

    origin_m: FloatArray
    """(3,) world point that is drawn at zero: the world's own origin unless that is very far away."""
    points_m: FloatArray
    """(n, 3) landmarks inside the box, minus the origin."""
    rows: IntArray
    """(n,) their rows among the solution's landmarks."""
    residual_px: FloatArray
    """(n,) RMS residual length of the observations of each that were used."""
    low_m: FloatArray
    """(3,) lower corner of the box, minus the origin."""
    high_m: FloatArray
    """(3,) upper corner of the box, minus the origin."""
    outside: int
    """How many usable landmarks lie outside the box."""
    unusable: int
    """How many landmarks have no finite point or no used observation."""
    residual_limit_px: float
    """Upper end of the colour scale; above 0."""

    @property
    def extent_m(self) -> float:
        """The longest horizontal side of the box."""
        return float(np.max((self.high_m - self.low_m)[:2]))


def landmark_residuals(solution: Solution) -> FloatArray:
    """(landmarks,) RMS residual length of the used observations of each at the end; NaN for none."""
    observations = solution.traverse.observations
    n = len(solution.landmark_track)
    if observations is None or n == 0:
        return np.full(n, np.nan)
    square = np.sum(solution.residual_final_px**2, axis=1)
    rows = np.flatnonzero(solution.used & np.isfinite(square))
    order = np.argsort(solution.landmark_track, kind="stable")
    known = solution.landmark_track[order]
    at = np.minimum(np.searchsorted(known, observations.track[rows]), n - 1)
    has_landmark = known[at] == observations.track[rows]
    landmark, rows = order[at[has_landmark]], rows[has_landmark]
    count = np.bincount(landmark, minlength=n)
    total = np.bincount(landmark, weights=square[rows], minlength=n)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def shown_terrain(solution: Solution) -> ShownTerrain:
    """Choose origin, box and landmarks of a solution.

    The box holds every stop and the landmarks up to three times the median distance from their nearest
    stop (or 95 % of them, if these are nearer).
    """
    _, stops_m = pose_arrays(solution.final.world_T_mast)
    origin_m = np.round(stops_m[0]) if np.abs(stops_m).max() > _FAR_WORLD_M else np.zeros(3)
    residual_px = landmark_residuals(solution)
    # Of a solution that ran away distances overflow.
    usable = np.isfinite(residual_px) & (np.abs(solution.final.landmarks_m) < _NOWHERE_M).all(axis=1)
    rows = np.flatnonzero(usable)
    points_m = solution.final.landmarks_m[rows]
    ground_m = stops_m - [0.0, 0.0, solution.traverse.rig.mast_height_m]
    corners = [stops_m, ground_m]
    if len(rows):
        distance_m, _ = scipy.spatial.cKDTree(stops_m).query(points_m)
        limit_m = min(np.quantile(distance_m, 0.95), 3 * np.median(distance_m))
        near = points_m[distance_m <= limit_m]
        corners.append(np.quantile(near, [0.01, 0.99], axis=0))
    hull = np.concatenate(corners)
    low, high = hull.min(axis=0), hull.max(axis=0)
    # A flat scene keeps some height, so that the vertical axis can be read.
    side = max(float(np.max((high - low)[:2])), _LEAST_EXTENT_M)
    grow = np.maximum(0.0, np.array([0.3, 0.3, 0.15]) * side - (high - low)) / 2
    low, high = low - grow, high + grow
    # Room around stops for their masts and labels.
    low[:2] = np.minimum(low[:2], stops_m[:, :2].min(axis=0) - _PAD * side)
    high[:2] = np.maximum(high[:2], stops_m[:, :2].max(axis=0) + _PAD * side)
    inside = np.all((points_m >= low) & (points_m <= high), axis=1)
    shown_px = residual_px[rows[inside]]
    limit_px = float(np.quantile(shown_px, 0.98)) if len(shown_px) else 0.0
    return ShownTerrain(
        origin_m=origin_m,
        points_m=points_m[inside] - origin_m,
        rows=rows[inside],
        residual_px=shown_px,
        low_m=low - origin_m,
        high_m=high - origin_m,
        outside=int(np.sum(~inside)),
        unusable=int(np.sum(~usable)),
        residual_limit_px=limit_px if limit_px > 0 else 1.0,
    )
