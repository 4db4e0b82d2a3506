"""The joint solver against an independent, dense one: plain formulas and SciPy's least squares.

Only the simulation and the result of the package are used: rotations, projection, the pan-tilt chain
and the priors are written out here from their definitions.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from experiments.running import Sample, attempt
from experiments.scenarios import navcam
from pancam_graph import SimulationOptions, SolveOptions, Traverse, simulate, solve

__all__ = ["NAME", "ValidationTask", "compare"]

NAME = "validation"
_Array = NDArray[np.float64]
_TINY = SimulationOptions(
    stops=2, spacing_m=3.0, pans=2, sweep_rad=0.8, tilts_rad=(-0.3,), points_per_image=6, reach_m=30.0
)


def _turn(w: _Array) -> _Array:
    """Rotation by a rotation vector: Rodrigues."""
    angle = float(np.sqrt(w @ w))
    k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    if angle < 1e-8:
        return np.asarray(np.eye(3) + k + k @ k / 2)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / angle**2 * k @ k)


def _log_pose(rotation: _Array, translation: _Array) -> _Array:
    """Twist (6,) of a rigid motion, rotation first: logarithm of SE(3)."""
    r = rotation
    sine = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / 2
    angle = float(np.arctan2(np.sqrt(sine @ sine), (np.trace(r) - 1) / 2))
    w = sine * (1 + angle**2 / 6 if angle < 1e-4 else angle / np.sin(angle))
    k = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    c = 1 / 12 if angle < 1e-3 else (1 - angle / 2 / np.tan(angle / 2)) / angle**2
    return np.concatenate([w, (np.eye(3) - k / 2 + c * k @ k) @ translation])


class _Dense:
    """All residuals of a mast traverse, one after the other, in the numbers (n,) that are adjusted."""

    def __init__(self, traverse: Traverse) -> None:
        self.t = traverse
        obs = traverse.observations
        assert obs is not None
        self.obs = obs
        self.track, self.row = np.unique(obs.track, return_inverse=True)
        self.n_stops, self.n_frames = len(traverse.stops) - 1, len(traverse.frames)

    def start(self, landmarks_m: _Array) -> _Array:
        """No correction of any stop, telemetry's angles, landmarks as given."""
        return np.concatenate(
            [np.zeros(6 * self.n_stops), self.t.pan_tilt_rad.ravel(), landmarks_m[self.track].ravel()]
        )

    def split(self, x: _Array) -> tuple[list[tuple[_Array, _Array]], _Array, _Array]:
        """Mast rotations and places, angles (frames, 2), landmarks (n, 3)."""
        a, b = 6 * self.n_stops, 6 * self.n_stops + 2 * self.n_frames
        masts = []
        for i, stop in enumerate(self.t.stops):
            R, p = stop.world_T_mast.rotation().matrix(), np.asarray(stop.world_T_mast.translation())
            if i > 0:
                twist = x[6 * (i - 1) : 6 * i]
                R, p = R @ _turn(twist[:3]), p + R @ twist[3:]
            masts.append((R, p))
        return masts, x[a:b].reshape(-1, 2), x[b:].reshape(-1, 3)

    def residuals(self, x: _Array) -> _Array:
        """Whitened residuals: pixels, then priors of angles, then those of stops."""
        masts, angles, points = self.split(x)
        t, out = self.t, []
        cameras = []
        for frame, eye in zip(t.image_frame, t.image_eye, strict=True):
            (R, p), (pan, tilt) = masts[t.frame_stop[frame]], angles[frame]
            for rotation, place in (
                (_turn(np.array([0.0, 0.0, pan])), np.zeros(3)),
                (t.rig.pan_T_tilt.rotation().matrix(), t.rig.pan_T_tilt.translation()),
                (_turn(np.array([0.0, -tilt, 0.0])), np.zeros(3)),
                (
                    t.rig.eyes[eye].head_T_camera.rotation().matrix(),
                    t.rig.eyes[eye].head_T_camera.translation(),
                ),
            ):
                R, p = R @ rotation, p + R @ place
            cameras.append((R, p, t.rig.pinholes[eye].calibration_matrix))
        for i, image in enumerate(self.obs.image):
            R, p, K = cameras[image]
            u, v, w = K @ R.T @ (points[self.row[i]] - p)
            out.append((np.array([u, v]) / w - self.obs.uv_px[i]) / self.obs.sigma_px[i])
        for i, f in enumerate(t.frames):
            out.append((angles[i] - t.pan_tilt_rad[i]) / [f.sigma_pan_rad, f.sigma_tilt_rad])
        for stop, (R, p) in zip(t.stops[1:], masts[1:], strict=True):
            R0, p0 = stop.world_T_mast.rotation().matrix(), stop.world_T_mast.translation()
            twist = _log_pose(R0.T @ R, R0.T @ (p - p0))
            out.append(twist / np.repeat([stop.sigma_rotation_rad, stop.sigma_translation_m], 3))
        return np.concatenate(out)


def compare(noise_px: float, seed: int) -> dict[str, float]:
    """Differences of the two optima, in cost and in the adjusted numbers."""
    simulation = simulate(navcam("both eyes"), replace(_TINY, noise_px=noise_px), seed=seed)
    t = simulation.traverse
    ours = solve(t, SolveOptions(rig="held", loss="none", relative_decrease=1e-14))
    dense = _Dense(t)
    theirs: Any = least_squares(
        dense.residuals,
        dense.start(simulation.truth.landmarks_m),
        jac="3-point",
        method="trf",
        x_scale="jac",
        ftol=1e-15,
        xtol=1e-15,
        gtol=1e-15,
    )
    masts, angles, points = dense.split(theirs.x)
    place = np.array([pose.translation() for pose in ours.final.world_T_mast])
    ours_m = ours.final.landmarks_m[np.searchsorted(ours.landmark_track, dense.track)]
    distance = np.linalg.norm(points, axis=1)
    return {
        "cost_relative": abs(ours.cost_final - theirs.cost) / theirs.cost,
        "angle_rad": float(np.abs(ours.final.pan_tilt_rad - angles).max()),
        "stop_m": float(np.abs(place - [p for _, p in masts]).max()),
        "landmark_relative": float((np.linalg.norm(ours_m - points, axis=1) / distance).max()),
    }


@dataclass(frozen=True, kw_only=True)
class ValidationTask:
    """One seed of the comparison."""

    noise_px: float
    seed: int

    def run(self) -> list[Sample]:
        """Solve with both solvers and compare."""
        metrics, failure = attempt(lambda: compare(self.noise_px, self.seed))
        return [
            Sample(
                experiment=NAME,
                model="mast",
                sharing="fixed",
                noise_px=self.noise_px,
                seed=self.seed,
                metrics=metrics,
                failure=failure,
            )
        ]
