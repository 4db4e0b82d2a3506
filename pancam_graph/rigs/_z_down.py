"""From the z-down frames of rovers (labels, documents) to our z-up ones: the only place that turns them.

x stays forward (or north); y and z change their sign, so that y points left (or west) and z up.
"""

import gtsam
import numpy as np

from pancam_graph.base.geometry import Z_DOWN_R_Z_UP, FloatArray
from pancam_graph.cameras import CAHV

__all__ = ["Z_UP_T_Z_DOWN", "camera_z_up", "pose_z_up", "vector_z_up"]

Z_UP_T_Z_DOWN = gtsam.Pose3(gtsam.Rot3(Z_DOWN_R_Z_UP), np.zeros(3))
"""A z-down frame in the z-up frame of the same place: its own inverse."""


def vector_z_up(vector: tuple[float, float, float]) -> FloatArray:
    """A point or a direction (3,)."""
    return np.asarray(Z_DOWN_R_Z_UP @ np.array(vector))


def pose_z_up(pose: gtsam.Pose3) -> gtsam.Pose3:
    """A pose of one z-down frame in another: that of the two z-up frames of the same places."""
    return Z_UP_T_Z_DOWN * pose * Z_UP_T_Z_DOWN


def camera_z_up(model: CAHV) -> CAHV:
    """A camera whose vectors are in a z-down frame."""
    return model.transformed(Z_UP_T_Z_DOWN)
