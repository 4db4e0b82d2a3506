"""Inverse ranges of landmarks, how well observations tell them, and landmarks moved along their rays."""

from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.landmarks._landmarks import CameraViews, Landmarks, Measurements, evaluate

__all__ = ["InverseRanges", "at_inverse_ranges", "inverse_ranges"]

_WEAK = 1e-12
"""Information added along every direction of a landmark, as a share of the trace of its information."""


@dataclass(frozen=True, kw_only=True, eq=False)
class InverseRanges:
    """Inverse ranges of landmarks from their origins, as observations tell them with cameras held."""

    per_m: FloatArray
    """(landmarks,) w / |X|: 0 at infinity, below 0 beyond it"""
    variance: FloatArray
    """(landmarks,) 1/m^2, its variance with the direction free"""
    shift: FloatArray
    """(landmarks, 4) change of (X, w) by the inverse range, with the direction at its best"""


def inverse_ranges(
    landmarks: Landmarks, measurements: Measurements, views: CameraViews, accepted: BoolArray
) -> InverseRanges:
    """Inverse ranges of landmarks at their best fit to the accepted (n,) measurements.

    The variance of a landmark without two rays that cross is very large, never infinite.
    """
    _, b, _ = evaluate(landmarks, measurements, views)
    b = b * accepted[:, None, None]
    information = np.add.reduceat(b.transpose(0, 2, 1) @ b, measurements.starts)
    trace = np.trace(information, axis1=1, axis2=2)
    information += (_WEAK * trace + 1e-200)[:, None, None] * np.eye(3)
    vector, length = landmarks.vector, landmarks.length.clip(1e-300)
    basis = _tangents(vector)
    by_vector = np.column_stack([-(vector[:, 3] / length**3)[:, None] * vector[:, :3], 1 / length])
    by_tangents = np.einsum("nk,nka->na", by_vector, basis)
    moved = np.linalg.solve(information, by_tangents[:, :, None])[:, :, 0]
    variance = np.einsum("na,na->n", by_tangents, moved)
    shift = np.einsum("nka,na->nk", basis, moved / variance[:, None])
    return InverseRanges(per_m=vector[:, 3] / length, variance=variance, shift=shift)


def at_inverse_ranges(landmarks: Landmarks, ranges: InverseRanges, per_m: FloatArray) -> Landmarks:
    """Landmarks at other inverse ranges (landmarks,), in the direction that fits best there."""
    x = landmarks.vector[:, :3] + ranges.shift[:, :3] * (per_m - ranges.per_m)[:, None]
    vector = np.column_stack([x / np.linalg.norm(x, axis=1, keepdims=True), per_m])
    return replace(landmarks, vector=vector / np.linalg.norm(vector, axis=1, keepdims=True))


def _tangents(vector: FloatArray) -> FloatArray:
    """Orthonormal bases (n, 4, 3) of the tangent spaces of S^3 at unit vectors, those of the kernel."""
    normal = vector.copy()
    normal[:, 0] += np.where(vector[:, 0] >= 0, 1.0, -1.0)
    square = np.einsum("nk,nk->n", normal, normal)
    return np.asarray(
        np.eye(4)[:, 1:] - (2 / square)[:, None, None] * normal[:, :, None] * normal[:, None, 1:]
    )
