"""Mast factor: a camera pose is tied to the mast through pan, tilt and its mount (6 rows).

    world_T_camera = world_T_mast . Rz(pan) . pan_T_tilt . Ry(-tilt) . tilted_T_head . head_T_camera

The residual is the camera pose relative to the pose of the chain: the rotation vector, radians, then the
translation, metres. Its sigma is the flex of the mast. `tilted_T_head` is how the head stands off where the
joints put it: the identity unless the frame has a flex of its own.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import (
    FloatArray,
    compose,
    pan_tilt_rotation,
    skew,
    so3_log,
    so3_right_jacobian_inverse,
)
from pancam_graph.factors._slots import Kind, PoseSlot, Slot, custom_factor

__all__ = ["mast_chain", "mast_factor", "mast_residual"]

Pose = tuple[FloatArray, FloatArray]
"""Rotations (..., 3, 3) and translations (..., 3)."""


def _transposed(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)


def _adjoint_of_inverse(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Adjoint (..., 6, 6) of the inverse of b_T_c: takes a body twist of a_T_b to one of a_T_c."""
    back = _transposed(rotation)
    out = np.zeros((*rotation.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = back
    out[..., 3:, :3] = -back @ skew(translation)
    return out


def mast_chain(
    world_T_mast: Pose,
    pan_tilt_rad: FloatArray,
    head_T_camera: Pose,
    pan_T_tilt: Pose,
    tilted_T_head: Pose | None = None,
) -> tuple[Pose, tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]]:
    """The camera pose by the chain, and its body-frame twists by mast, pan, tilting down, tilt axis and head.

    Poses are pairs of rotations (..., 3, 3) and translations (..., 3); twists (..., 6, 6), of pan and tilt
    (..., 6, 1), rotation first. The twist of the camera by the mount is that of the mount itself. No
    `tilted_T_head` is the identity.
    """
    pan, tilt = pan_tilt_rad[..., 0], pan_tilt_rad[..., 1]
    none = np.zeros(3)

    # The chain from each joint outwards to the camera.
    head_to_camera = head_T_camera if tilted_T_head is None else compose(*tilted_T_head, *head_T_camera)
    tilt_to_camera = compose(pan_tilt_rotation(0.0 * tilt, tilt), none, *head_to_camera)
    pan_to_camera = compose(*pan_T_tilt, *tilt_to_camera)
    mast_to_camera = compose(pan_tilt_rotation(pan, 0.0 * pan), none, *pan_to_camera)
    return compose(*world_T_mast, *mast_to_camera), (
        _adjoint_of_inverse(*mast_to_camera),
        _adjoint_of_inverse(*pan_to_camera)[..., 2:3],
        _adjoint_of_inverse(*head_to_camera)[..., 1:2],
        _adjoint_of_inverse(*tilt_to_camera),
        _adjoint_of_inverse(*head_T_camera),
    )


def mast_residual(
    world_T_camera: Pose,
    world_T_mast: Pose,
    pan_tilt_rad: FloatArray,
    head_T_camera: Pose,
    pan_T_tilt: Pose,
    tilted_T_head: Pose | None = None,
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Residuals (..., 6), and Jacobians by camera, mast, pan-tilt, mount, tilt axis and, where given, head.

    Poses are pairs of rotations and translations; Jacobians (..., 6, 6), by pan-tilt (..., 6, 2), are by
    body-frame tangents, rotation first.
    Defined where camera and chain differ by less than half a turn.
    """
    camera_R, camera_t = world_T_camera
    (chain_R, chain_t), (by_mast, by_pan, by_down, by_axis, by_head) = mast_chain(
        world_T_mast, pan_tilt_rad, head_T_camera, pan_T_tilt, tilted_T_head
    )
    back = _transposed(chain_R)
    turn = back @ camera_R
    rotation = so3_log(turn)
    shift = (back @ (camera_t - chain_t)[..., None])[..., 0]
    right_inverse = so3_right_jacobian_inverse(rotation)

    d_camera = np.zeros((*turn.shape[:-2], 6, 6))
    d_camera[..., :3, :3] = right_inverse
    d_camera[..., 3:, 3:] = turn
    d_chain = np.zeros_like(d_camera)
    d_chain[..., :3, :3] = -right_inverse @ _transposed(turn)
    d_chain[..., 3:, :3] = skew(shift)
    d_chain[..., 3:, 3:] = -np.eye(3)

    d_pan_tilt = np.concatenate([d_chain @ by_pan, -d_chain @ by_down], axis=-1)
    rigid = d_camera, d_chain @ by_mast, d_pan_tilt, d_chain, d_chain @ by_axis
    by_variables = rigid if tilted_T_head is None else (*rigid, d_chain @ by_head)
    return np.concatenate([rotation, shift], axis=-1), by_variables


def mast_factor(
    noise: gtsam.noiseModel.Base,
    world_T_camera: Slot | Sequence[Slot],
    world_T_mast: Slot | Sequence[Slot],
    pan_tilt_rad: Slot | Sequence[Slot],
    head_T_camera: PoseSlot | Sequence[PoseSlot],
    pan_T_tilt: PoseSlot | Sequence[PoseSlot],
    tilted_T_head: PoseSlot | Sequence[PoseSlot] | None = None,
) -> gtsam.CustomFactor:
    """The factor of `mast_residual`: slots of Pose3, Pose3, vector of 2, and three of Pose3; noise of 6 rows.

    For n images at once each slot is a sequence of n, and the noise has 6 n rows. No `tilted_T_head` is the
    identity.
    """
    slots: list[tuple[PoseSlot | Sequence[PoseSlot], Kind]] = [
        (world_T_camera, "pose"),
        (world_T_mast, "pose"),
        (pan_tilt_rad, "vector"),
        (head_T_camera, "pose"),
        (pan_T_tilt, "pose"),
    ]
    if tilted_T_head is not None:
        slots.append((tilted_T_head, "pose"))
    return custom_factor(noise, slots, mast_residual)
