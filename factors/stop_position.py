"""Stop position factor: the origin of a mast is at a known place, along some axes of the world.

residual = (world_t_mast - position) along these axes, metres
"""

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.factors._slots import Slot, custom_factor

__all__ = ["stop_position_factor", "stop_position_residual"]


def stop_position_residual(
    world_T_mast: tuple[FloatArray, FloatArray], position_m: FloatArray, axes: IntArray
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Residuals (n, k), metres, and the Jacobian (n, k, 6) by the mast's tangent.

    `world_T_mast` are rotations (n, 3, 3) and translations (n, 3); `position_m` (k,) are known coordinates
    along the axes (k,) of the world.
    """
    rotation, translation = world_T_mast
    residual = translation[:, axes] - position_m
    jacobian = np.concatenate([np.zeros((len(residual), len(axes), 3)), rotation[:, axes]], axis=2)
    return residual, (jacobian,)


def stop_position_factor(
    noise: gtsam.noiseModel.Base, world_T_mast: Slot, *, position_m: FloatArray, axes: IntArray
) -> gtsam.CustomFactor:
    """The factor of `stop_position_residual`; the noise has a row an axis."""
    return custom_factor(
        noise, [(world_T_mast, "pose")], lambda pose: stop_position_residual(pose, position_m, axes)
    )
