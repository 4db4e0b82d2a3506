"""Where an uncertain place may be: covariances in world axes, and the outlines of their ellipses."""

import numpy as np

from pancam_graph.base.geometry import FloatArray

__all__ = ["RADIUS_95", "ellipse_outlines", "translation_covariance_in_world"]

_ELLIPSE_STEPS = 48
RADIUS_95 = float(np.sqrt(-2 * np.log(1 - 0.95)))
"""Radius, in standard deviations, of the ellipse that holds 95 % of a plane normal distribution."""


def translation_covariance_in_world(world_R_mast: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariances of positions in world axes (n, 3, 3) from those of poses in body axes (n, 6, 6).

    A pose moves as `world_T_mast * Exp([w, v])`, rotation first: its position moves by
    `world_R_mast v`, so the lower right block is turned by world_R_mast (n, 3, 3) from both sides.
    """
    return np.asarray(world_R_mast @ covariance[:, 3:, 3:] @ np.swapaxes(world_R_mast, 1, 2))


def ellipse_outlines(covariance_m2: FloatArray, radius: float) -> FloatArray:
    """Closed outlines (n, steps, 2) about zero of the ellipses of covariances (n, 2, 2).

    `radius` is in standard deviations. Round-off below zero in an eigenvalue counts as zero.
    """
    angle = np.linspace(0, 2 * np.pi, _ELLIPSE_STEPS + 1)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    value, vector = np.linalg.eigh(covariance_m2)
    half_axes = vector * np.sqrt(np.maximum(value, 0.0))[:, None, :]
    return np.asarray(radius * circle @ np.swapaxes(half_axes, 1, 2))
