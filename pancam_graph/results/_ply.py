"""Landmarks as a point cloud: PLY, binary little endian."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.data import Solution
from pancam_graph.io import read_bytes
from pancam_graph.results._output import OutputWriter, Written

__all__ = ["POINTS", "PlyPoints", "points_ply", "read_points", "worst_sigma_m"]

_COLOURS = ("red", "green", "blue")
_TYPES = {"double": "<f8", "float": "<f4", "int": "<i4", "uchar": "u1"}
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
        vertices["sigma_m"] = worst_sigma_m(covariance[kept])
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


@dataclass(frozen=True, kw_only=True, eq=False)
class PlyPoints:
    """Landmarks of a `points.ply`."""

    xyz_m: FloatArray
    """(n, 3)"""
    track: IntArray
    """(n,)"""
    sigma_m: FloatArray
    """(n,) along the worst direction; NaN where the file has none."""


def read_points(path: Path) -> PlyPoints:
    """Read a file of `points_ply`. Raises InputError for any other PLY, and for one that is cut off."""
    content = read_bytes(path)
    head, end, rest = content.partition(b"end_header\n")
    lines = head.decode("ascii", "replace").splitlines()
    expected = f"{path}: expected the points of a solution (binary PLY with x, y, z and track)"
    words = [line.split() for line in lines]
    properties = [w[1:] for w in words if w[:1] == ["property"]]
    count = next((w[2] for w in words if w[:2] == ["element", "vertex"] and len(w) == 3), "")
    known = all(len(p) == 2 and p[0] in _TYPES for p in properties)
    names = [p[-1] for p in properties]
    if (
        not end
        or ["format", "binary_little_endian", "1.0"] not in words
        or not known
        or not count.isdecimal()
    ):
        raise InputError(f"{expected}, found something else")
    if not {"x", "y", "z", "track"} <= set(names) or len(set(names)) != len(names):
        raise InputError(f"{expected}, found the properties {', '.join(names) or 'none'}")
    row = np.dtype([(name, _TYPES[kind]) for kind, name in properties])
    if len(rest) != int(count) * row.itemsize:
        raise InputError(f"{expected}, found {len(rest)} bytes for {count} points of {row.itemsize} bytes")
    vertices = np.frombuffer(rest, dtype=row)
    return PlyPoints(
        xyz_m=np.column_stack([vertices[axis] for axis in "xyz"]).astype(float),
        track=vertices["track"].astype(np.int64),
        sigma_m=(vertices["sigma_m"].astype(float) if "sigma_m" in names else np.full(len(vertices), np.nan)),
    )


def worst_sigma_m(covariance_m2: FloatArray) -> FloatArray:
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
