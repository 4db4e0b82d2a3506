"""Landmarks as a point cloud: PLY, binary little endian."""

import numpy as np

from pancam_graph.geometry import FloatArray, IntArray
from pancam_graph.solution import Solution

__all__ = ["points_ply"]

_INT32_MAX = np.iinfo(np.int32).max


def points_ply(solution: Solution) -> bytes:
    """The landmarks of a solution as a PLY file; world frame, metres.

    A vertex has x, y, z (double), `track` (its number), `residual_px` (RMS length of the final residuals of
    the observations used; NaN where there is none) and `observations` (how many were used). Landmarks
    without a usable point are left out.
    """
    count, rms = _per_landmark(solution)
    points = solution.final.landmarks_m
    kept = np.isfinite(points).all(axis=1)
    track = solution.landmark_track[kept]
    # PLY has no integers of 64 bits; a double holds the larger numbers exactly up to 2^53.
    track_type = ("double", "<f8") if np.any(track > _INT32_MAX) else ("int", "<i4")
    properties = [
        ("x", "double", "<f8"),
        ("y", "double", "<f8"),
        ("z", "double", "<f8"),
        ("track", *track_type),
        ("residual_px", "float", "<f4"),
        ("observations", "int", "<i4"),
    ]
    vertices = np.empty(int(kept.sum()), dtype=[(name, numpy_type) for name, _, numpy_type in properties])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[kept, axis]
    vertices["track"], vertices["residual_px"], vertices["observations"] = track, rms[kept], count[kept]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment pancam_graph landmarks, world frame, metres",
        f"element vertex {len(vertices)}",
        *(f"property {ply_type} {name}" for name, ply_type, _ in properties),
        "end_header",
    ]
    return "\n".join([*header, ""]).encode("ascii") + vertices.tobytes()


def _per_landmark(solution: Solution) -> tuple[IntArray, FloatArray]:
    """Number of used observations of each landmark, and the RMS length of their final residuals."""
    observations = solution.traverse.observations
    n = len(solution.landmark_track)
    if observations is None or n == 0:
        return np.zeros(n, dtype=np.int64), np.full(n, np.nan)
    squared = np.sum(solution.residual_final_px**2, axis=1)
    order = np.argsort(solution.landmark_track)
    place = np.searchsorted(solution.landmark_track, observations.track, sorter=order)
    row = order[np.minimum(place, n - 1)]
    use = solution.used & np.isfinite(squared) & (solution.landmark_track[row] == observations.track)
    count = np.bincount(row[use], minlength=n)
    total = np.bincount(row[use], weights=squared[use], minlength=n)
    rms = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
    return count.astype(np.int64), rms
