"""Which observations to believe: data snooping with cameras held, one observation at a time.

Each residual is compared with what noise alone makes of it, given that the landmark follows its own
observations (Baarda 1968). A track loses only its worst observation at a time and is triangulated again;
rejected observations that fit again come back.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from pancam_graph.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.landmarks import (
    CameraViews,
    Landmarks,
    Measurements,
    evaluate,
    free_derivatives,
    refine,
    residual_cofactor,
    triangulate,
)

__all__ = ["Screening", "rays_of", "screen"]

_MIN_REDUNDANCY = 0.02
"""Directions of a residual that keep less than this of the noise's variance cannot show an error."""

_SWEEPS = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class Screening:
    """Outcome of one screening."""

    landmarks: Landmarks
    accepted: BoolArray
    """(n,)"""
    scale: float
    """Robust estimate of the noise in units of the given sigmas."""
    behind: BoolArray
    """(n,) whether the landmark is behind the camera."""


def rays_of(measurements: Measurements, views: CameraViews) -> tuple[FloatArray, FloatArray]:
    """Centres (n, 3) and unit directions (n, 3) of the measurements' lines of sight, in the world."""
    image = measurements.image
    homogeneous = np.column_stack([measurements.uv_px, np.ones(len(image))])
    in_camera = np.linalg.solve(views.calibration[image], homogeneous[..., None])
    direction = (views.world_R_camera[image] @ in_camera)[..., 0]
    return views.world_t_camera[image], direction / np.linalg.norm(direction, axis=1, keepdims=True)


def screen(
    landmarks: Landmarks,
    measurements: Measurements,
    views: CameraViews,
    accepted: BoolArray,
    *,
    cutoff_sigma: float,
    min_scale: float,
) -> Screening:
    """Reject and re-admit observations with all cameras held.

    `accepted` (n,) is where to start. An observation goes when its test exceeds the chi-square quantile
    that a Gaussian exceeds beyond `cutoff_sigma`, in units of a robust scale that is at least `min_scale`.
    Of a track with two observations that disagree both go, for nothing tells which is wrong.
    """
    k = measurements.landmark
    accepted = _revive(accepted, k)
    revived = _count(accepted, k) == _count(np.ones_like(accepted), k)
    landmarks = _retriangulate(landmarks, measurements, views, accepted, only=revived)
    tail = 2 * norm.sf(cutoff_sigma)
    limit = np.array([np.inf, chi2.isf(tail, 1), chi2.isf(tail, 2)])
    scale, in_front = min_scale, np.ones_like(accepted)
    for sweep in range(_SWEEPS):
        landmarks = refine(landmarks, measurements, views, accepted.astype(float))
        residual, b, in_front = evaluate(landmarks, measurements, views)
        b = free_derivatives(b, landmarks, measurements)
        cofactor = residual_cofactor(b, measurements, accepted.astype(float))
        test, dof = _normalised(residual, cofactor)
        if sweep == 0:
            scale = max(min_scale, _robust_scale(test[accepted & in_front], dof[accepted & in_front]))
        # What takes part may not exceed the noise itself, even where its cofactor shows no direction of it.
        length = np.einsum("ni,ni->n", residual, residual)
        excess = test / scale**2 - limit[dof]
        excess = np.where(accepted, np.maximum(excess, length / scale**2 - limit[2]), excess)
        excess = np.where(in_front, excess, np.inf)
        bad = accepted & (excess > 0)
        goes = bad & (
            excess >= np.maximum.reduceat(np.where(accepted, excess, -np.inf), measurements.starts)[k]
        )
        goes |= bad & (_count(accepted, k) <= 2)[k]
        comes = ~accepted & in_front & (excess < 0) & (dof > 0) if sweep == 0 else np.zeros_like(bad)
        comes &= (_count(accepted & ~goes, k) >= 2)[k]
        if not (goes.any() or comes.any()):
            break
        accepted = (accepted & ~goes) | comes
        lost = np.zeros(measurements.n_landmarks, dtype=bool)
        lost[k[goes]] = True
        landmarks = _retriangulate(landmarks, measurements, views, accepted, only=lost)
    return Screening(landmarks=landmarks, accepted=accepted, scale=scale, behind=~in_front)


def _count(mask: BoolArray, landmark: IntArray) -> IntArray:
    return np.bincount(landmark, mask, minlength=int(landmark[-1]) + 1).astype(np.int64)


def _revive(accepted: BoolArray, landmark: IntArray) -> BoolArray:
    """Give landmarks that lost their observations all of them back, to be judged anew."""
    return np.asarray(accepted | (_count(accepted, landmark) < 2)[landmark])


def _retriangulate(
    landmarks: Landmarks,
    measurements: Measurements,
    views: CameraViews,
    accepted: BoolArray,
    *,
    only: BoolArray,
) -> Landmarks:
    if not only.any():
        return landmarks
    centre, direction = rays_of(measurements, views)
    fresh = triangulate(centre, direction, measurements.landmark, accepted.astype(float))
    usable = only & (_count(accepted, measurements.landmark) > 0)
    return Landmarks(
        vector=np.where(usable[:, None], fresh.vector, landmarks.vector),
        origin_m=np.where(usable[:, None], fresh.origin_m, landmarks.origin_m),
    )


def _normalised(residual: FloatArray, cofactor: FloatArray) -> tuple[FloatArray, IntArray]:
    """Squared residuals in units of their own covariance, and over how many directions (0, 1 or 2)."""
    values, vectors = np.linalg.eigh(cofactor)
    shown = values > _MIN_REDUNDANCY
    along = np.einsum("nij,ni->nj", vectors, residual) ** 2 / np.where(shown, values, 1.0)
    return np.sum(along * shown, axis=1), shown.sum(axis=1)


def _robust_scale(test: FloatArray, dof: IntArray) -> float:
    """Noise scale from the median of the tests, each over the median that noise of scale 1 would give."""
    expected = np.array([np.nan, chi2.median(1), chi2.median(2)])
    ratio = test[dof > 0] / expected[dof[dof > 0]]
    return float(np.sqrt(np.median(ratio))) if len(ratio) else 0.0
