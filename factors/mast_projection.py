"""Mast projection factor: an observation of a terrain point by a camera on a rigid mast (2 rows).

    world_T_camera = world_T_mast . Rz(pan) . pan_T_tilt . Ry(-tilt) . head_T_camera

The residual is the point's projection less the measured pixel, in pixels of the pinhole; the noise model
whitens it. The chain is that of `mast`, without flex.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, skew
from pancam_graph.cameras import CALIBRATION_ENTRIES
from pancam_graph.factors._slots import PoseSlot, Slot, custom_factor
from pancam_graph.factors.mast import Pose, mast_chain

__all__ = ["mast_projection_factor", "mast_projection_residual"]

_BEHIND_PX = 1e6
"""Residual in each row for a point that is not in front of its camera, so that an optimiser rejects it."""


def mast_projection_residual(
    point_m: FloatArray,
    world_T_mast: Pose,
    pan_tilt_rad: FloatArray,
    head_T_camera: Pose,
    pan_T_tilt: Pose,
    calibration: FloatArray,
    uv_px: FloatArray,
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Residuals (n, 2), pixels, and Jacobians by point, mast, pan-tilt, mount, tilt axis, calibration.

    Points (n, 3) are in the world; poses are pairs of rotations (n, 3, 3) and translations (n, 3);
    `calibration` (n, 3, 3) is K, its Jacobian (n, 2, 5) by fx, fy, skew, cx, cy; those by poses are by
    body-frame tangents, rotation first. A point that is not in front of its camera has a large constant
    residual, with Jacobians of 0.
    """
    (chain_R, chain_t), (by_mast, by_pan, by_down, by_axis) = mast_chain(
        world_T_mast, pan_tilt_rad, head_T_camera, pan_T_tilt
    )
    back = np.swapaxes(chain_R, -1, -2)
    seen = (back @ (point_m - chain_t)[..., None])[..., 0]
    depth = seen[:, 2]
    ahead = depth > 0
    depth = np.where(ahead, depth, 1.0)
    x, y = seen[:, 0] / depth, seen[:, 1] / depth
    K = calibration
    residual = np.column_stack([K[:, 0, 0] * x + K[:, 0, 1] * y, K[:, 1, 1] * y]) + K[:, :2, 2] - uv_px
    d_seen = np.zeros((len(x), 2, 3))
    d_seen[:, :, :2] = K[:, :2, :2] / depth[:, None, None]
    d_seen[:, :, 2] = -(d_seen[:, :, 0] * x[:, None] + d_seen[:, :, 1] * y[:, None])
    # A rotation and a translation of the camera in its own frame move the point the other way.
    d_camera = d_seen @ np.concatenate([skew(seen), np.broadcast_to(-np.eye(3), (len(x), 3, 3))], axis=-1)
    d_calibration = np.zeros((len(x), 2, 5))
    for column, (row, entry) in enumerate(zip(*CALIBRATION_ENTRIES, strict=True)):
        d_calibration[:, row, column] = (x, y, 1.0)[entry]
    jacobians = (
        d_seen @ back,
        d_camera @ by_mast,
        np.concatenate([d_camera @ by_pan, -d_camera @ by_down], axis=-1),
        d_camera,
        d_camera @ by_axis,
        d_calibration,
    )
    residual[~ahead] = _BEHIND_PX
    for jacobian in jacobians:
        jacobian[~ahead] = 0.0
    return residual, jacobians


def mast_projection_factor(
    noise: gtsam.noiseModel.Base,
    point_m: Slot | Sequence[Slot],
    world_T_mast: Slot | Sequence[Slot],
    pan_tilt_rad: Slot | Sequence[Slot],
    head_T_camera: PoseSlot | Sequence[PoseSlot],
    pan_T_tilt: PoseSlot | Sequence[PoseSlot],
    calibration: Slot | Sequence[Slot],
    *,
    nominal: FloatArray,
    basis: FloatArray,
    uv_px: FloatArray,
) -> gtsam.CustomFactor:
    """The factor of `mast_projection_residual`: slots of Point3, Pose3, vector of 2, Pose3, Pose3, vector.

    The last slot has the free entries of a correction of K, which `basis` (n, 5, entries) takes to changes of
    fx, fy, skew, cx and cy of `nominal` (n, 3, 3); no entries where K is fixed. For n observations at once
    each slot is a sequence of n, and the noise has 2 n rows.
    """
    row, column = CALIBRATION_ENTRIES

    def residual(
        point: FloatArray, mast: Pose, pan_tilt: FloatArray, mount: Pose, axis: Pose, entries: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        K = nominal.copy()
        K[:, row, column] += np.einsum("nij,nj->ni", basis, entries)
        error, (*others, d_calibration) = mast_projection_residual(
            point, mast, pan_tilt, mount, axis, K, uv_px
        )
        return error, (*others, d_calibration @ basis)

    return custom_factor(
        noise,
        (
            (point_m, "point"),
            (world_T_mast, "pose"),
            (pan_tilt_rad, "vector"),
            (head_T_camera, "pose"),
            (pan_T_tilt, "pose"),
            (calibration, "vector"),
        ),
        residual,
    )
