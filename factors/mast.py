"""Mast factor: an image's camera pose hangs on the mast by pan, tilt and its mount (6 rows).

    world_T_camera = world_T_mast . Rz(pan) . pan_T_tilt . Ry(-tilt) . head_T_camera

The residual is what is left of it: the rotation vector, radians, then the shift, metres, of the
camera as seen from where the chain puts it. Its sigma stands for the flex of the mast.
"""

import gtsam
import numpy as np

from pancam_graph.factors._slots import PoseSlot, Slot, custom_factor
from pancam_graph.geometry import FloatArray, ry, rz, skew, so3_right_jacobian_inverse

__all__ = ["mast_factor", "mast_residual"]

Pose = tuple[FloatArray, FloatArray]
"""Rotation (3, 3) and translation (3,)."""


def _adjoint_of_inverse(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Takes a body twist of `a_T_b` to that of `a_T_b * b_T_c`, given `b_T_c`, (6, 6)."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation.T
    out[3:, :3] = -rotation.T @ skew(translation)
    return out


def mast_residual(
    world_T_camera: Pose, world_T_mast: Pose, pan_tilt_rad: FloatArray, head_T_camera: Pose, pan_T_tilt: Pose
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Residual (6,) and its Jacobians by camera, mast (6, 6 each), pan-tilt (6, 2), mount, tilt axis (6, 6).

    Poses are pairs of rotation and translation; Jacobians are by body-frame tangents, rotation first.
    Defined where camera and chain differ by less than half a turn.
    """
    camera_R, camera_t = world_T_camera
    mast_R, mast_t = world_T_mast
    mount_R, mount_t = head_T_camera
    axis_R, axis_t = pan_T_tilt
    pan_R, tilt_R = rz(pan_tilt_rad[0]), ry(-pan_tilt_rad[1])

    # The chain from each joint outwards to the camera.
    tilt_to_camera = tilt_R @ mount_R, tilt_R @ mount_t
    pan_to_camera = axis_R @ tilt_to_camera[0], axis_R @ tilt_to_camera[1] + axis_t
    mast_to_camera = pan_R @ pan_to_camera[0], pan_R @ pan_to_camera[1]
    chain_R, chain_t = mast_R @ mast_to_camera[0], mast_R @ mast_to_camera[1] + mast_t

    turn = chain_R.T @ camera_R
    rotation = gtsam.Rot3.Logmap(gtsam.Rot3(turn))
    shift = chain_R.T @ (camera_t - chain_t)
    right_inverse = so3_right_jacobian_inverse(rotation)

    d_camera = np.zeros((6, 6))
    d_camera[:3, :3] = right_inverse
    d_camera[3:, 3:] = turn
    d_chain = np.zeros((6, 6))
    d_chain[:3, :3] = -right_inverse @ turn.T
    d_chain[3:, :3] = skew(shift)
    d_chain[3:, 3:] = -np.eye(3)

    d_mast = d_chain @ _adjoint_of_inverse(*mast_to_camera)
    d_pan = d_chain @ _adjoint_of_inverse(*pan_to_camera)[:, 2]
    d_tilt = -d_chain @ _adjoint_of_inverse(mount_R, mount_t)[:, 1]
    d_axis = d_chain @ _adjoint_of_inverse(*tilt_to_camera)
    d_pan_tilt = np.column_stack([d_pan, d_tilt])
    return np.concatenate([rotation, shift]), (d_camera, d_mast, d_pan_tilt, d_chain, d_axis)


def mast_factor(
    noise: gtsam.noiseModel.Base,
    world_T_camera: Slot,
    world_T_mast: Slot,
    pan_tilt_rad: Slot,
    head_T_camera: PoseSlot,
    pan_T_tilt: PoseSlot,
) -> gtsam.CustomFactor:
    """The factor of `mast_residual`: slots of Pose3, Pose3, vector of 2, Pose3, Pose3; noise of 6 rows."""

    def residual(
        camera: gtsam.Pose3, mast: gtsam.Pose3, pan_tilt: FloatArray, mount: gtsam.Pose3, axis: gtsam.Pose3
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        camera_pose, mast_pose, mount_pose, axis_pose = (
            (p.rotation().matrix(), p.translation()) for p in (camera, mast, mount, axis)
        )
        return mast_residual(camera_pose, mast_pose, pan_tilt, mount_pose, axis_pose)

    slots = (
        (world_T_camera, gtsam.Values.atPose3),
        (world_T_mast, gtsam.Values.atPose3),
        (pan_tilt_rad, gtsam.Values.atVector),
        (head_T_camera, gtsam.Values.atPose3),
        (pan_T_tilt, gtsam.Values.atPose3),
    )
    return custom_factor(noise, slots, residual)
