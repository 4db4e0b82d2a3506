"""The common motion of a block's stops, under which the block's linearisation stays valid.

A block's quadratic, in the body-frame tangents of its mast poses, is exact under a rigid motion of the world:
with T_i = exp(xi) theta_i the tangent is Ad(theta_i)^-1 xi, however large xi is. So only the motion of stops
relative to each other limits a linearisation; landmarks are moved with the common motion.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.elimination import Posture
from pancam_graph.landmarks import Landmarks

__all__ = ["CommonMotion", "carried", "orthonormal", "posture_in"]


class CommonMotion:
    """Least-squares rigid motion of the world that explains how masts moved since they were linearised."""

    def __init__(self, theta: Sequence[gtsam.Pose3], unit: FloatArray, *, held: bool) -> None:
        """Take linearisation points and `unit` (6,), the angles and distances of equal weight.

        `held`: one of the masts is fixed, and the common motion is therefore zero.
        """
        self._unit = np.tile(unit, len(theta))
        alike = np.concatenate([np.zeros((0, 6)), *(pose.inverse().AdjointMap() for pose in theta)])
        self._alike = (0.0 if held else 1.0) * alike / self._unit[:, None]
        self._solve = np.linalg.pinv(self._alike)

    def of(self, delta: FloatArray) -> tuple[FloatArray, float]:
        """Fit the common motion to tangents (6n,) of masts: its twist (6,), and the largest residual.

        The residual is the motion of a mast that remains, in units.
        """
        scaled = delta / self._unit
        twist = self._solve @ scaled
        return twist, float(np.abs(scaled - self._alike @ twist).max(initial=0.0))


def carried(landmarks: Landmarks, by: gtsam.Pose3) -> Landmarks:
    """Landmarks after a rigid motion of the world."""
    rotation, shift = by.rotation().matrix(), by.translation()
    vector = landmarks.vector.copy()
    vector[:, :3] = vector[:, :3] @ rotation.T
    return Landmarks(vector=vector, origin_m=landmarks.origin_m @ rotation.T + shift)


def posture_in(posture: Posture, by: gtsam.Pose3) -> Posture:
    """Cameras after a rigid motion of the world; the chain rule in body-frame tangents stays the same."""
    rotation, shift = by.rotation().matrix(), by.translation()
    return Posture(
        views=posture.views.after(rotation, shift),
        unit_R=rotation @ posture.unit_R,
        unit_t=posture.unit_t @ rotation.T + shift,
        chain=posture.chain,
    )


def orthonormal(pose: gtsam.Pose3) -> gtsam.Pose3:
    """The pose with the rotation matrix nearest to its own, free of rounding.

    Where each stop's pose is a product with the poses before, rounding errors triple at every stop; after
    thirty stops the product is no rotation matrix.
    """
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(pose.rotation().matrix()), pose.translation())
