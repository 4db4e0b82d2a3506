"""Errors of a solution of a simulated drive in its own sigmas, and whether it has found the outliers."""

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Solution
from pancam_graph.simulate import Simulation

__all__ = ["errors_in_sigmas", "require_right"]


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
