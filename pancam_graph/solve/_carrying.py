"""Measured pixels of distorted cameras, carried to the pinholes that the compiled loops see."""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras import carry_to_pinhole
from pancam_graph.data import Observations, PixelNoise
from pancam_graph.graph import RigVariables
from pancam_graph.solve._problem import Problem

__all__ = ["carried_again", "carry", "first_ranges_m", "is_carried_anew"]

_TYPICAL_RANGE_M = 10.0
"""Range at which pixels of a camera with a moving pupil are carried before their landmark has a place."""
_CARRIED_PX = 1e-6
"""Pixels are carried anew until none moves by more than this."""


def carry(
    observations: Observations, range_m: FloatArray, rig: RigVariables, values: gtsam.Values
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Pixels of n observations as the pinholes of the rig at the values would see the same points.

    `range_m` (n,) is the distance of each point from its camera. Returns pixels (n, 2), matrices (n, 2, 2)
    that turn residuals of the pinhole into residuals of the image, and validity (n,): False outside the
    domain of the camera model, where the other two mean nothing.
    """
    n = len(observations)
    uv_px, turn, valid = np.empty((n, 2)), np.empty((n, 2, 2)), np.empty(n, dtype=bool)
    for camera, images in rig.cameras(values):
        of_camera = images[observations.image]
        uv_px[of_camera], turn[of_camera], valid[of_camera] = carry_to_pinhole(
            camera, observations.uv_px[of_camera], range_m[of_camera]
        )
    return uv_px, turn, valid


def first_ranges_m(observations: Observations) -> FloatArray:
    """Ranges (n,) to carry pixels with before landmarks have a place."""
    return np.full(len(observations), _TYPICAL_RANGE_M)


def is_carried_anew(problem: Problem) -> bool:
    """Whether carried pixels depend on what is estimated: on ranges, or on a calibration with distortion."""
    rig = problem.template.rig_variables
    return rig.pupil_moves or rig.distortion_moves


def carried_again(problem: Problem, observations: Observations, noise: PixelNoise) -> Problem:
    """The problem with its pixels carried with its own cameras and ranges; the same object if none moves."""
    m = problem.measurements
    centre = problem.views.world_t_camera[m.image]
    measured_m = np.linalg.norm(problem.points_m()[m.landmark] - centre, axis=1)
    range_m = first_ranges_m(observations)
    range_m[m.row] = np.where(np.isfinite(measured_m), measured_m, _TYPICAL_RANGE_M)
    uv_px, turn, valid = carry(observations, range_m, problem.template.rig_variables, problem.values)
    keep = valid[m.row, None]
    carried_px = np.where(keep, uv_px[m.row], m.uv_px)
    if np.linalg.norm(carried_px - m.uv_px, axis=1).max(initial=0.0) < _CARRIED_PX:
        return problem
    whitening = np.where(keep[:, :, None], noise.select(m.row).whiten(turn[m.row]), m.whitening)
    return replace(problem, measurements=replace(m, uv_px=carried_px, whitening=whitening))
