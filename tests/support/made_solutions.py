"""Solutions made without a solver, for tests of the report."""

from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph import Frame, Image, Observations, Stop, Traverse
from pancam_graph.base.geometry import BoolArray, FloatArray, rz
from pancam_graph.data import Seconds, Solution, State
from pancam_graph.rigs import Rig, mer_navcam

SIGMA_RAD = 1.34e-3
"""Sigma of the telemetry's pan and tilt."""


def _traverse_of(
    rig: Rig,
    masts: tuple[gtsam.Pose3, ...],
    pan_tilt_rad: FloatArray,
    folder: Path | None,
    ids: Callable[[str], str],
) -> Traverse:
    """A traverse with this telemetry, all eyes in each frame; the first stop is held."""
    pans = len(pan_tilt_rad) // len(masts)
    return Traverse(
        name=ids("test traverse"),
        rig=rig,
        folder=folder,
        stops=tuple(
            Stop(
                id=ids(f"stop{s}"),
                world_T_mast=pose,
                sigma_rotation_rad=0.005 if s else 0.0,
                sigma_translation_m=0.05 if s else 0.0,
            )
            for s, pose in enumerate(masts)
        ),
        frames=tuple(
            Frame(
                id=ids(f"frame{f}"),
                stop=ids(f"stop{f // pans}"),
                pan_rad=pan,
                tilt_rad=tilt,
                sigma_pan_rad=SIGMA_RAD,
                sigma_tilt_rad=SIGMA_RAD,
            )
            for f, (pan, tilt) in enumerate(pan_tilt_rad.tolist())
        ),
        images=tuple(
            Image(
                id=ids(f"image{f}{eye.name}"),
                frame=ids(f"frame{f}"),
                camera=eye.name,
                file=f"{f}{eye.name}.png" if folder else None,
            )
            for f in range(len(pan_tilt_rad))
            for eye in rig.eyes
        ),
    )


def _state(
    traverse: Traverse, masts: tuple[gtsam.Pose3, ...], angles: FloatArray, landmarks_m: FloatArray
) -> State:
    R, t = traverse.camera_poses(masts, angles)
    return State(
        world_T_mast=masts,
        pan_tilt_rad=angles,
        world_R_camera=R,
        world_t_camera=t,
        landmarks_m=landmarks_m.copy(),
    )


def _observed(
    traverse: Traverse, truth: State, noise_px: float, outliers: float, rng: np.random.Generator
) -> tuple[Observations, BoolArray]:
    """Observations of about every second landmark in view, and whether each is an outlier."""
    landmarks, points = truth.landmarks_m, len(truth.landmarks_m)
    rows = []
    for image, (R, t) in enumerate(zip(truth.world_R_camera, truth.world_t_camera, strict=True)):
        camera = traverse.rig.eyes[traverse.image_eye[image]].camera
        uv, valid = camera.project((landmarks - t) @ R)
        seen = np.flatnonzero(valid & camera.contains(uv) & (rng.random(points) < 0.6))
        rows.append(np.column_stack([np.full(len(seen), image), seen, uv[seen]]))
    table = np.concatenate(rows)
    uv = table[:, 2:] + rng.normal(0, noise_px, (len(table), 2)) if noise_px else table[:, 2:]
    bad = rng.random(len(table)) < outliers
    uv[bad] += rng.uniform(20, 90, (int(bad.sum()), 2))
    observations = Observations(
        image=table[:, 0].astype(np.int64),
        track=2 * table[:, 1].astype(np.int64) + 1,  # numbers may leave gaps
        uv_px=uv,
        sigma_px=np.full(len(uv), noise_px or 0.5),
    )
    return observations, bad


def _residuals(traverse: Traverse, observations: Observations, at: State) -> FloatArray:
    """Projection less observation, pixels (observations, 2)."""
    out = np.full((len(observations), 2), np.nan)
    for image in range(len(traverse.images)):
        rows = observations.image == image
        camera = traverse.rig.eyes[traverse.image_eye[image]].camera
        point = at.landmarks_m[observations.track[rows] // 2]
        uv, _ = camera.project((point - at.world_t_camera[image]) @ at.world_R_camera[image])
        out[rows] = uv - observations.uv_px[rows]
    return out


def fabricate(
    *,
    rig: Rig | None = None,
    stops: int = 2,
    pans: int = 6,
    points: int = 300,
    spacing_m: float = 5.0,
    noise_px: float = 0.3,
    outliers: float = 0.03,
    seed: int = 0,
    model: str = "mast",
    folder: Path | None = None,
    ids: Callable[[str], str] = lambda name: name,
) -> Solution:
    """A solution without a solver: its start is disturbed telemetry, its end the truth."""
    rng = np.random.default_rng(seed)
    rig = rig or mer_navcam()
    mast_m = np.column_stack([spacing_m * np.arange(stops), np.zeros(stops), np.full(stops, 1.5)])
    true_masts = tuple(gtsam.Pose3(gtsam.Rot3(rz(0.3 * s)), mast_m[s]) for s in range(stops))
    held = [s == 0 for s in range(stops)]
    noise = np.concatenate([rng.normal(0, 0.005, (stops, 3)), rng.normal(0, 0.05, (stops, 3))], axis=1)
    given_masts = tuple(
        pose if fixed else pose.retract(d) for pose, d, fixed in zip(true_masts, noise, held, strict=True)
    )
    true_angles = np.array([[2 * np.pi * p / pans, -0.15] for _ in range(stops) for p in range(pans)])
    given_angles = true_angles + rng.normal(0, SIGMA_RAD, true_angles.shape)
    traverse = _traverse_of(rig, given_masts, given_angles, folder, ids)
    distance = np.exp(rng.uniform(np.log(2.0), np.log(40.0), points))
    bearing, home = rng.uniform(0, 2 * np.pi, points), rng.integers(stops, size=points)
    landmarks = mast_m[home] + np.column_stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-1.6, -0.5, points)]
    )
    initial = _state(traverse, given_masts, given_angles, landmarks)
    final = _state(traverse, true_masts, true_angles, landmarks)
    observations, bad = _observed(traverse, final, noise_px, outliers, rng)
    before, after = (_residuals(traverse, observations, at) for at in (initial, final))
    covariance = np.zeros((stops, 6, 6))
    for s in range(1, stops):
        root = rng.normal(0, 1, (6, 6)) * np.array([2e-4] * 3 + [2e-3] * 3)[:, None]
        covariance[s] = root @ root.T
    return Solution(
        traverse=traverse.with_observations(observations),
        model=model,
        landmarks="explicit",
        converged=True,
        stop_reason="the cost fell by less than 1e-9 of itself",
        iterations=6,
        cost_history=(9000.0, 1000.0),
        cost_initial=9000.0,
        cost_final=1000.0,
        initial=initial,
        final=final,
        landmark_track=2 * np.arange(points) + 1,
        used=~bad,
        reason=tuple("outlier" if b else "" for b in bad),
        residual_initial_px=before,
        residual_final_px=after,
        sigma_px=observations.sigma_px,
        stop_covariance=covariance,
        angle_sigma_rad=np.full(true_angles.shape, 1e-4),
        seconds=Seconds(read=0.1, initialise=0.2, solve=1.5),
    )
