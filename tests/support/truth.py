"""Errors of solutions of simulated and rendered drives, and whether outliers were found."""

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Solution
from pancam_graph.simulate import Rendering, Simulation

__all__ = ["errors_in_sigmas", "place_error", "relative_rms_rad", "require_right"]


def errors_in_sigmas(simulation: Simulation, solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Errors of pan and tilt (frames, 2), and of the stops that are not held (stops,), in formal sigmas."""
    angles = (solution.final.pan_tilt_rad - simulation.truth.pan_tilt_rad) / solution.angle_sigma_rad
    stops = []
    for pose, true, covariance in zip(
        solution.final.world_T_mast, simulation.truth.world_T_mast, solution.stop_covariance, strict=True
    ):
        if covariance.any():
            error = true.localCoordinates(pose)
            stops.append(np.sqrt(error @ np.linalg.solve(covariance, error) / 6))
    return angles, np.array(stops)


def require_right(simulation: Simulation, solution: Solution) -> None:
    """Converged within its sigmas, with nearly all outliers left out."""
    angles, stops = errors_in_sigmas(simulation, solution)
    wrong = simulation.truth.outlier
    assert solution.converged
    assert np.abs(angles).max() < 6
    assert stops.max(initial=0.0) < 3
    assert (~solution.used[wrong]).mean() > 0.99
    assert np.isfinite(solution.rms_final_px)


def place_error(rendering: Rendering, solution: Solution) -> float:
    """Of the second stop in the mast frame of the first, as a share of the distance."""
    true, found = (
        m[0].between(m[1]).translation() for m in (rendering.truth.world_T_mast, solution.final.world_T_mast)
    )
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def relative_rms_rad(rendering: Rendering, solution: Solution) -> FloatArray:
    """RMS error (stops, 2) of pan and tilt relative to the mean of the stop."""
    error = solution.final.pan_tilt_rad - rendering.truth.pan_tilt_rad
    error = np.arctan2(np.sin(error), np.cos(error))
    stop = solution.traverse.frame_stop
    return np.array([np.std(error[stop == s], axis=0) for s in range(len(solution.traverse.stops))])
