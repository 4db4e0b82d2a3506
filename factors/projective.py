"""Projective factor: a projection matrix hangs on the mast as a camera of the rig does (12 rows).

The matrix is split, P = s K R [I | -C]: what is left of R and C beside the chain (`mast_residual`, 6 rows,
radians and metres), of K beside the rig's (fx, fy, skew, cx, cy, pixels) and the logarithm of s. Images say
nothing of s; each matrix has its own, and this row alone holds it.
"""

import gtsam
import numpy as np

from pancam_graph.cameras import CALIBRATION_ENTRIES, Conditioning, projection_tangents, split_projections
from pancam_graph.factors._slots import PoseSlot, Slot, custom_factor
from pancam_graph.factors.mast import Pose, mast_residual
from pancam_graph.geometry import FloatArray

__all__ = ["projective_factor", "projective_residual"]

_NO_CAMERA = 1e6
"""What each row of a matrix without a camera says: no step of an optimiser ends there."""


def projective_residual(
    projection: FloatArray,
    world_T_mast: Pose,
    pan_tilt_rad: FloatArray,
    head_T_camera: Pose,
    pan_T_tilt: Pose,
    calibration: FloatArray,
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Residual (12,), Jacobians by P (12, 12), mast (12, 6), pan-tilt (12, 2), mount and axis (12, 6 each).

    P (3, 4) takes homogeneous points of the world to pixels; poses are pairs of rotation and translation,
    `calibration` (3, 3) is the rig's K. P's entries count row by row, other Jacobians are by body-frame
    tangents. A matrix that is no camera (left block of rank below 3) has a large residual that moves nowhere.
    """
    K, R, C, s = split_projections(projection[None])
    d_mast, d_pan_tilt, d_mount, d_axis = (np.zeros((12, k)) for k in (6, 2, 6, 6))
    if not all(np.all(np.isfinite(part)) for part in (K, R, C, s)):
        return np.full(12, _NO_CAMERA), (np.zeros((12, 12)), d_mast, d_pan_tilt, d_mount, d_axis)
    camera = R[0].T, C[0]
    pose, (d_camera, *others) = mast_residual(camera, world_T_mast, pan_tilt_rad, head_T_camera, pan_T_tilt)
    d_mast[:6], d_pan_tilt[:6], d_mount[:6], d_axis[:6] = others
    numbers = (K[0] - calibration)[CALIBRATION_ENTRIES]
    d_projection = projection_tangents(K, R, C, s)[0]
    d_projection[:6] = d_camera @ d_projection[:6]
    residual = np.concatenate([pose, numbers, np.log(s)])
    return residual, (d_projection, d_mast, d_pan_tilt, d_mount, d_axis)


def projective_factor(
    noise: gtsam.noiseModel.Base,
    entries: Slot,
    world_T_mast: Slot,
    pan_tilt_rad: Slot,
    head_T_camera: PoseSlot,
    pan_T_tilt: PoseSlot,
    calibration: FloatArray,
    conditioning: Conditioning,
) -> gtsam.CustomFactor:
    """The factor of `projective_residual`: slots of a vector of 12, Pose3, vector of 2, Pose3, Pose3.

    The vector has the entries of a conditioned P; `conditioning` is of this one image. The noise has 12 rows.
    """
    d_undo, origin_m = conditioning.d_undo[0], conditioning.origin_m[0]

    def residual(
        entries: FloatArray, mast: gtsam.Pose3, pan_tilt: FloatArray, mount: gtsam.Pose3, axis: gtsam.Pose3
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        mast_pose = mast.rotation().matrix(), mast.translation() - origin_m
        mount_pose, axis_pose = ((p.rotation().matrix(), p.translation()) for p in (mount, axis))
        projection = conditioning.undo(entries[None])[0]
        error, (d_projection, *others) = projective_residual(
            projection, mast_pose, pan_tilt, mount_pose, axis_pose, calibration
        )
        return error, (d_projection @ d_undo, *others)

    slots = (
        (entries, gtsam.Values.atVector),
        (world_T_mast, gtsam.Values.atPose3),
        (pan_tilt_rad, gtsam.Values.atVector),
        (head_T_camera, gtsam.Values.atPose3),
        (pan_T_tilt, gtsam.Values.atPose3),
    )
    return custom_factor(noise, slots, residual)
