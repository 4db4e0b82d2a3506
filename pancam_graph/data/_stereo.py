"""How surely the two eyes of a frame place what they see, noise of pixels apart."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pancam_graph.base.geometry import FloatArray, IntArray

__all__ = ["StereoCovariance", "StereoNodes", "stereo_order"]

_ALIKE_FOCAL = 1.5
"""Factor by which focal lengths of a pair of eyes may differ."""
_LEAST_BASELINE_M = 1e-3
_ALIKE_AXES = np.cos(np.deg2rad(30.0))


def stereo_order(
    focal_px: tuple[float, float], world_R_camera: FloatArray, world_t_camera: FloatArray
) -> tuple[int, int] | None:
    """Which of two cameras, 0 and 1, is the left and which the right one; None where they see no stereo.

    Stereo takes two centres 1 mm apart or more, focal lengths that differ by less than half, and axes within
    30 degrees of each other. Orientations (2, 3, 3), centres (2, 3). An eye above the other is turned.
    """
    between = world_t_camera[1] - world_t_camera[0]
    axes = world_R_camera[:, :, 2]
    alike = max(focal_px) < _ALIKE_FOCAL * min(focal_px) and axes[0] @ axes[1] > _ALIKE_AXES
    if not alike or np.linalg.norm(between) < _LEAST_BASELINE_M:
        return None
    # The first axis that the baseline has a larger part of decides.
    to_right, down = between @ world_R_camera[0][:, 0], between @ world_R_camera[0][:, 1]
    first = to_right if abs(to_right) >= abs(down) else down
    return (0, 1) if first > 0 else (1, 0)


class StereoNodes(NamedTuple):
    """What `StereoCovariance` has of one pair."""

    extent: FloatArray
    """(4,)"""
    covariance: FloatArray
    """(depths, rows, columns, 6)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class StereoCovariance:
    """Covariances of places that stereo pairs see, due to poses, angles and the rig: pixels count as exact.

    These errors are common to neighbouring places, so no number of pixels averages them out. They are given
    at nodes of direction and depth in the left camera, for x/z, y/z and the relative error of z: entries xx,
    xy, xz, yy, yz, zz. Between nodes they are linear in all three coordinates.
    """

    left: IntArray
    """(pairs,) row of the image whose camera has the nodes"""
    right: IntArray
    """(pairs,) row of the image that sees in stereo with it"""
    extent: FloatArray
    """(pairs, 4) least and largest x/z, least and largest y/z: nodes are evenly spaced, ends included"""
    depth_m: FloatArray
    """(depths,) z of the nodes, ascending, metres"""
    covariance: FloatArray
    """(pairs, depths, rows, columns, 6) by y/z along rows and x/z along columns; no units"""

    def of(self, left: int, right: int) -> StereoNodes | None:
        """The nodes of a pair of images; None where it is not among the pairs."""
        row = self._row.get((left, right))
        return None if row is None else StereoNodes(self.extent[row], self.covariance[row])

    @cached_property
    def _row(self) -> dict[tuple[int, int], int]:
        pairs = zip(self.left.tolist(), self.right.tolist(), strict=True)
        return {pair: row for row, pair in enumerate(pairs)}
