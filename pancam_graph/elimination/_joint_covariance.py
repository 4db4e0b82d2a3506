"""Joint covariance of any two poses of a solved system, whether or not a factor joins them."""

from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.elimination._panels import Root

__all__ = ["JointCovariance", "PosePlace", "relative_pose_covariance"]


@dataclass(frozen=True, kw_only=True, eq=False)
class PosePlace:
    """Columns of a pose in a system."""

    group: int
    """Group of its variable."""
    columns: slice
    """Its six columns among those of the group."""
    held: IntArray
    """Components of its tangent that telemetry holds while others are free."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JointCovariance:
    """Joint marginal covariances of pairs of poses, computed on request."""

    root: Root
    """Square root of the whole system, which must have full rank."""
    places: tuple[PosePlace | None, ...]
    """Of each pose; None where it is held."""

    def of(self, i: int, j: int) -> FloatArray:
        """Joint covariance (12, 12) of poses i and j, everything else marginalised; 0 where held.

        In body-frame tangents, rotation first: those of pose i, then those of pose j.
        """
        out = np.zeros((12, 12))
        begin = np.concatenate([[0], np.cumsum(self.root.structure.dim)])
        pair = (self.places[i], self.places[j])
        for b, two in enumerate(pair):
            if two is None:
                continue
            columns = self.root.inverse_columns(two.group, two.columns)
            columns[:, two.held] = 0.0
            for a, one in enumerate(pair):
                if one is None:
                    continue
                first = int(begin[one.group])
                block = columns[first + one.columns.start : first + one.columns.stop].copy()
                block[one.held] = 0.0
                out[6 * a : 6 * a + 6, 6 * b : 6 * b + 6] = block
        return np.asarray((out + out.T) / 2)


def relative_pose_covariance(world_T_a: gtsam.Pose3, world_T_b: gtsam.Pose3, joint: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a_T_b, from the joint one (12, 12) of a and b as `JointCovariance.of` gives it.

    In the body-frame tangent of b, rotation first: to first order the tangent of a_T_b is b's less a's, the
    latter transformed to b's frame.
    """
    by_a = -world_T_b.between(world_T_a).AdjointMap()
    jacobian = np.hstack([by_a, np.eye(6)])
    return np.asarray(jacobian @ joint @ jacobian.T)
