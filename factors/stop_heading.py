"""Stop heading factor: the x axis of a mast points in a known direction, seen from above (one row).

residual = atan2(x axis along world y, x axis along world x) - heading, radians, within half a turn
"""

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, wrap_angle
from pancam_graph.factors._slots import Slot, custom_factor

__all__ = ["stop_heading_factor", "stop_heading_residual"]

_VERTICAL = 1e-12
"""Squared sine of the zenith distance of the x axis below which it has no heading."""


def stop_heading_residual(
    world_T_mast: tuple[FloatArray, FloatArray], heading_rad: float
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Residuals (n, 1), radians, and the Jacobian (n, 1, 6) by the mast's tangent.

    `world_T_mast` are rotations (n, 3, 3) and translations (n, 3). A mast whose x axis is vertical has no
    heading: its Jacobian is 0.
    """
    rotation, _ = world_T_mast
    x, y, z = rotation[:, :2, 0], rotation[:, :2, 1], rotation[:, :2, 2]
    square = np.sum(x**2, axis=1)
    # The x axis moves by y along a turn about z, and by -z along one about y.
    across = np.stack([-x[:, 1], x[:, 0]], axis=1) / np.maximum(square, _VERTICAL)[:, None]
    across[square < _VERTICAL] = 0.0
    jacobian = np.zeros((len(rotation), 1, 6))
    jacobian[:, 0, 1] = -np.sum(across * z, axis=1)
    jacobian[:, 0, 2] = np.sum(across * y, axis=1)
    heading = np.arctan2(x[:, 1], x[:, 0])
    return np.asarray(wrap_angle(heading - heading_rad))[:, None], (jacobian,)


def stop_heading_factor(
    noise: gtsam.noiseModel.Base, world_T_mast: Slot, *, heading_rad: float
) -> gtsam.CustomFactor:
    """The factor of `stop_heading_residual`."""
    return custom_factor(
        noise, [(world_T_mast, "pose")], lambda pose: stop_heading_residual(pose, heading_rad)
    )
