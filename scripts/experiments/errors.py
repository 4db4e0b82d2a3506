"""Errors of a solution against the truth, after an alignment in the directions that no image determines.

A similarity, estimated on the camera centres alone (Umeyama 1991), is applied to centres and landmarks, which
brings both into one frame. Rotations are aligned by their own mean: a circle of 0.14 m turns with the
millimetres of its centres. Where a stop's place is asked for, nothing may be scaled: there the first stop's
cameras are laid on the true ones by a rigid motion.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from pancam_graph import Solution, Traverse
from pancam_graph.base.geometry import FloatArray
from pancam_graph.simulate import Simulation

__all__ = [
    "NEAR_M",
    "Similarity",
    "aligned_centres",
    "distances_percent",
    "errors_of",
    "mean_rotation",
    "places_m",
    "umeyama",
]

NEAR_M = 5.0
"""A landmark is near if its distance from the nearest mast is below this."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Similarity:
    """Takes points p to scale * rotation @ p + translation."""

    scale: float
    rotation: FloatArray
    """(3, 3)"""
    translation_m: FloatArray
    """(3,)"""

    def points(self, points_m: FloatArray) -> FloatArray:
        """Points (n, 3) moved."""
        return np.asarray(self.scale * points_m @ self.rotation.T + self.translation_m)


def umeyama(source_m: FloatArray, target_m: FloatArray) -> Similarity:
    """The similarity that takes points (n, 3) nearest to others in least squares (Umeyama 1991, eq. 40-43).

    Points all in one place have no scale: it stays 1.
    """
    source_mean, target_mean = source_m.mean(axis=0), target_m.mean(axis=0)
    source, target = source_m - source_mean, target_m - target_mean
    u, singular, vt = np.linalg.svd(target.T @ source)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    spread = float(np.sum(source**2))
    scale = float(singular @ sign) / spread if spread > 0 else 1.0
    return Similarity(
        scale=scale, rotation=rotation, translation_m=target_mean - scale * rotation @ source_mean
    )


def mean_rotation(rotations: FloatArray) -> FloatArray:
    """The rotation nearest to the mean of rotations (n, 3, 3): the chordal mean."""
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    return np.asarray((u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)


def errors_of(solution: Solution, simulation: Simulation) -> dict[str, float]:
    """Every metric of the solution of a simulated traverse, by name; a name ends with its unit.

    A landmark that the solution places beyond infinity counts at its place, far off. One that the solution
    does not have makes the metrics of landmarks NaN.
    """
    t, truth, final = solution.traverse, simulation.truth, solution.final
    true_R, true_t = _true_cameras(simulation)
    aligned = umeyama(final.world_t_camera, true_t)
    centre = aligned.points(final.world_t_camera) - true_t
    mean = mean_rotation(true_R @ final.world_R_camera.transpose(0, 2, 1))
    turn = true_R.transpose(0, 2, 1) @ mean @ final.world_R_camera
    metrics: dict[str, float] = {
        "centre_mm": 1e3 * _rms(centre),
        "rotation_mrad": 1e3 * float(np.sqrt(np.mean(_angle_rad(turn) ** 2))),
        "scale_percent": 100 * abs(aligned.scale - 1),
    }
    landmarks = truth.landmarks_m[solution.landmark_track]
    error = aligned.points(final.landmarks_m) - landmarks
    masts = np.array([pose.translation() for pose in truth.world_T_mast])
    is_near = np.linalg.norm(landmarks[:, None] - masts, axis=2).min(axis=1) < NEAR_M
    on_near = umeyama(final.landmarks_m[is_near], landmarks[is_near]) if is_near.any() else aligned
    metrics |= {
        "landmark_m": _rms(error),
        "landmark_median_m": float(np.median(np.linalg.norm(error, axis=1))),
        "landmark_near_m": _rms(error[is_near]),
        "landmark_far_m": _rms(error[~is_near]),
        "landmark_near_aligned_on_itself_m": _rms(
            on_near.points(final.landmarks_m[is_near]) - landmarks[is_near]
        ),
        "focal_percent": _focal_percent(solution, simulation),
        "reprojection_px": solution.rms_final_px,
        "iterations": float(solution.iterations),
    }
    if len(t.stops) > 1:
        stop = t.image_stop
        places, true_places = places_m(t, final.world_t_camera), places_m(t, true_t)
        by_itself = np.concatenate(
            [
                aligned_centres(final.world_t_camera[stop == s], true_t[stop == s]) - true_t[stop == s]
                for s in range(len(t.stops))
            ]
        )
        metrics["centre_within_mm"] = 1e3 * _rms(by_itself)
        metrics["distance_aligned_percent"] = distances_percent(
            t, aligned.points(final.world_t_camera), true_t
        )
        metrics["distance_percent"] = distances_percent(t, final.world_t_camera, true_t)
        first = stop == 0
        rotation = mean_rotation(true_R[first] @ final.world_R_camera[first].transpose(0, 2, 1))
        ahead = (places[-1] - places[0]) @ rotation.T - (true_places[-1] - true_places[0])
        travelled = np.linalg.norm(np.diff(true_places, axis=0), axis=1).sum()
        metrics["localisation_percent"] = 100 * float(np.linalg.norm(ahead) / travelled)
    return metrics


def _true_cameras(simulation: Simulation) -> tuple[FloatArray, FloatArray]:
    """Rotations and centres of all images, by the true rig; solvers may have been told another."""
    truth = simulation.truth
    of_true_rig = replace(simulation.traverse, rig=truth.rig)
    return of_true_rig.camera_poses(truth.world_T_mast, truth.pan_tilt_rad)


def _focal_percent(solution: Solution, simulation: Simulation) -> float:
    """RMS over images of the relative error of fx and fy."""
    true = replace(simulation.traverse, rig=simulation.truth.rig).calibration
    calibration = solution.calibration
    ratio = calibration[:, [0, 1], [0, 1]] / true[:, [0, 1], [0, 1]]
    return 100 * float(np.sqrt(np.mean((ratio - 1) ** 2)))


def aligned_centres(centre_m: FloatArray, true_m: FloatArray) -> FloatArray:
    """Centres (n, 3) after the similarity that takes them nearest to the true ones."""
    return umeyama(centre_m, true_m).points(centre_m)


def places_m(traverse: Traverse, centre_m: FloatArray) -> FloatArray:
    """Mean (stops, 3) of the centres (images, 3) of each stop."""
    stop = traverse.image_stop
    return np.array([centre_m[stop == s].mean(axis=0) for s in range(len(traverse.stops))])


def distances_percent(traverse: Traverse, centre_m: FloatArray, true_m: FloatArray) -> float:
    """RMS over pairs of stops of the relative error of the distance of their places."""
    places, true_places = places_m(traverse, centre_m), places_m(traverse, true_m)
    pairs = np.array(list(combinations(range(len(places)), 2)))
    estimated, true = (np.linalg.norm(p[pairs[:, 1]] - p[pairs[:, 0]], axis=1) for p in (places, true_places))
    return 100 * float(np.sqrt(np.mean((estimated / true - 1) ** 2)))


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1)))) if len(vectors) else np.nan


def _angle_rad(rotations: FloatArray) -> FloatArray:
    """Angle of each rotation (n, 3, 3), exact for small ones."""
    r = rotations
    sine = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    angle = np.arctan2(np.linalg.norm(sine, axis=1) / 2, (np.trace(r, axis1=1, axis2=2) - 1) / 2)
    return np.asarray(angle, dtype=float)
