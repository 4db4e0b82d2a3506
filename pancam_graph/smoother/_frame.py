"""The common motion of stops, which changes nothing in what a block of landmarks says.

A block's quadratic, in the body-frame tangents of its mast poses, is exact under a motion of the whole: with
T_i = exp(xi) theta_i the tangent is Ad(theta_i)^-1 xi, however large xi is. So only the motion of stops
against each other limits where a linearisation is good; landmarks are carried along by the common motion.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import Posture
from pancam_graph.landmarks import CameraViews, Landmarks

__all__ = ["CommonMotion", "carried", "orthonormal", "posture_in"]


class CommonMotion:
    """The motion of the world that moves some masts from where they were linearised as they moved."""

    def __init__(self, theta: Sequence[gtsam.Pose3], unit: FloatArray, *, held: bool) -> None:
        """`unit` (6,) are the angles and distances that weigh alike.

        `held`: one of the masts cannot move, and so neither can the world.
        """
        self._unit = np.tile(unit, len(theta))
        alike = np.concatenate([np.zeros((0, 6)), *(pose.inverse().AdjointMap() for pose in theta)])
        self._alike = (0.0 if held else 1.0) * alike / self._unit[:, None]
        self._solve = np.linalg.pinv(self._alike)

    def of(self, delta: FloatArray) -> tuple[FloatArray, float]:
        """Twist (6,) of the world, and the most that masts do beside it in units, from tangents (6n,)."""
        scaled = delta / self._unit
        twist = self._solve @ scaled
        return twist, float(np.abs(scaled - self._alike @ twist).max(initial=0.0))


def carried(landmarks: Landmarks, by: gtsam.Pose3) -> Landmarks:
    """Landmarks moved with the world."""
    rotation, shift = by.rotation().matrix(), by.translation()
    vector = landmarks.vector.copy()
    vector[:, :3] = vector[:, :3] @ rotation.T
    return Landmarks(vector=vector, origin_m=landmarks.origin_m @ rotation.T + shift)


def posture_in(posture: Posture, by: gtsam.Pose3) -> Posture:
    """Cameras moved with the world; how they hang on the variables does not change."""
    rotation, shift, views = by.rotation().matrix(), by.translation(), posture.views
    return Posture(
        views=CameraViews(
            world_R_camera=rotation @ views.world_R_camera,
            world_t_camera=views.world_t_camera @ rotation.T + shift,
            calibration=views.calibration,
        ),
        unit_R=rotation @ posture.unit_R,
        unit_t=posture.unit_t @ rotation.T + shift,
        chain=posture.chain,
    )


def orthonormal(pose: gtsam.Pose3) -> gtsam.Pose3:
    """The same pose, its rotation freed of rounding.

    Where each stop's pose is a product with those of the stops before, rounding triples at every stop: after
    thirty it is no rotation any more.
    """
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(pose.rotation().matrix()), pose.translation())
