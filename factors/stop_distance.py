"""Stop distance factor: the origins of two masts are a known distance apart (one row).

residual = |world_t_b - world_t_a| - distance, metres
"""

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.factors._slots import Slot, custom_factor

__all__ = ["stop_distance_factor", "stop_distance_residual"]


def stop_distance_residual(
    world_T_a: tuple[FloatArray, FloatArray], world_T_b: tuple[FloatArray, FloatArray], distance_m: float
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Residuals (n, 1), metres, and Jacobians (n, 1, 6) by the tangents of both masts.

    Poses are rotations (n, 3, 3) and translations (n, 3). Where both origins coincide there is no direction:
    the Jacobian there is that along the world's x axis.
    """
    arm = world_T_b[1] - world_T_a[1]
    length = np.linalg.norm(arm, axis=1, keepdims=True)
    along = np.where(length > 0, arm / np.where(length > 0, length, 1.0), [1.0, 0.0, 0.0])[:, None]
    none = np.zeros_like(along)
    by_a = np.concatenate([none, -along @ world_T_a[0]], axis=2)
    by_b = np.concatenate([none, along @ world_T_b[0]], axis=2)
    return length - distance_m, (by_a, by_b)


def stop_distance_factor(
    noise: gtsam.noiseModel.Base, world_T_a: Slot, world_T_b: Slot, *, distance_m: float
) -> gtsam.CustomFactor:
    """The factor of `stop_distance_residual`."""
    return custom_factor(
        noise,
        [(world_T_a, "pose"), (world_T_b, "pose")],
        lambda a, b: stop_distance_residual(a, b, distance_m),
    )
