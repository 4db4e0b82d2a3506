"""Landmarks as a point cloud: PLY, binary little endian."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import Solution
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["POINTS", "points_ply"]

_COLOURS = ("red", "green", "blue")
_INT32_MAX = np.iinfo(np.int32).max


def points_ply(solution: Solution, grey: NDArray[np.uint8] | None = None) -> bytes:
    """The landmarks of a solution as a PLY file; world frame, metres.

    A vertex has x, y, z (double), `track` (its number), `residual_px` (RMS length of the final residuals of
    the observations used; NaN where there is none) and `observations` (how many were used). Where the
    solution has covariances of landmarks, `sigma_m`: the standard deviation along the point's worst
    direction, formal. With `grey` (landmarks,), 0 to 255: `red`, `green`, `blue`, all three equal to the
    grey: the names by which viewers find colours. Landmarks without a usable point are left out.
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
    covariance = solution.landmark_covariance_m2
    if covariance is not None:
        properties.append(("sigma_m", "float", "<f4"))
    if grey is not None:
        properties += [(colour, "uchar", "u1") for colour in _COLOURS]
    vertices = np.empty(int(kept.sum()), dtype=[(name, numpy_type) for name, _, numpy_type in properties])
    for axis, name in enumerate("xyz"):
        vertices[name] = points[kept, axis]
    vertices["track"], vertices["residual_px"], vertices["observations"] = track, rms[kept], count[kept]
    if covariance is not None:
        vertices["sigma_m"] = _worst_sigma_m(covariance[kept])
    if grey is not None:
        for colour in _COLOURS:
            vertices[colour] = grey[kept]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment pancam_graph landmarks, world frame, metres",
        f"element vertex {len(vertices)}",
        *(f"property {ply_type} {name}" for name, ply_type, _ in properties),
        "end_header",
    ]
    return "\n".join([*header, ""]).encode("ascii") + vertices.tobytes()


def _worst_sigma_m(covariance_m2: FloatArray) -> FloatArray:
    """Square root (n,) of the largest eigenvalue of covariances (n, 3, 3); NaN where they are not finite."""
    known: BoolArray = np.asarray(np.isfinite(covariance_m2).all(axis=(1, 2)))
    largest = np.linalg.eigvalsh(np.where(known[:, None, None], covariance_m2, 0.0))[:, -1]
    return np.asarray(np.where(known, np.sqrt(np.maximum(largest, 0.0)), np.nan))


def _per_landmark(solution: Solution) -> tuple[IntArray, FloatArray]:
    """Number of used observations of each landmark, and the RMS length of their final residuals."""
    n, row = len(solution.landmark_track), solution.landmark_row
    squared = np.sum(solution.residual_final_px**2, axis=1)
    use = solution.used & np.isfinite(squared) & (row >= 0)
    count = np.bincount(row[use], minlength=n)
    total = np.bincount(row[use], weights=squared[use], minlength=n)
    rms = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
    return count.astype(np.int64), rms


def _write(written: Written, path: Path) -> Written:
    path.write_bytes(points_ply(written.solution, written.brightness.grey))
    return written


POINTS = OutputWriter(write=_write)
