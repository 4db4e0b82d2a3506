"""Mast projection factor: an observation of a terrain point by a camera on a rigid mast (2 rows).

    world_T_camera = world_T_mast . Rz(pan) . pan_T_tilt . Ry(-tilt) . tilted_T_head . head_T_camera

It is the factor of `camera_projection` with the camera's pose by the chain of `mast`, whose sigma is 0.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CALIBRATION_ENTRIES, Camera
from pancam_graph.factors._slots import Kind, PoseSlot, Slot, custom_factor
from pancam_graph.factors.camera_projection import camera_projection_residual
from pancam_graph.factors.mast import Pose, mast_chain

__all__ = ["mast_projection_factor", "mast_projection_residual"]


def mast_projection_residual(
    point_m: FloatArray,
    world_T_mast: Pose,
    pan_tilt_rad: FloatArray,
    head_T_camera: Pose,
    pan_T_tilt: Pose,
    calibration: FloatArray,
    lens: Camera,
    uv_px: FloatArray,
    tilted_T_head: Pose | None = None,
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Residuals (n, 2), pixels, and Jacobians by point, mast, pan-tilt, mount, tilt axis, calibration, head.

    Poses are pairs of rotations (n, 3, 3) and translations (n, 3), their Jacobians by body-frame tangents,
    rotation first; all else as for `camera_projection_residual`. The last Jacobian is there where
    `tilted_T_head` is given; else that is the identity.
    """
    chain, (by_mast, by_pan, by_down, by_axis, by_head) = mast_chain(
        world_T_mast, pan_tilt_rad, head_T_camera, pan_T_tilt, tilted_T_head
    )
    residual, (d_point, d_camera, d_calibration) = camera_projection_residual(
        point_m, chain, calibration, lens, uv_px
    )
    d_axis, d_pan_tilt = d_camera @ by_axis, np.concatenate([d_camera @ by_pan, -d_camera @ by_down], axis=-1)
    rigid = d_point, d_camera @ by_mast, d_pan_tilt, d_camera, d_axis, d_calibration
    return residual, rigid if tilted_T_head is None else (*rigid, d_camera @ by_head)


def mast_projection_factor(
    noise: gtsam.noiseModel.Base,
    point_m: Slot | Sequence[Slot],
    world_T_mast: Slot | Sequence[Slot],
    pan_tilt_rad: Slot | Sequence[Slot],
    head_T_camera: PoseSlot | Sequence[PoseSlot],
    pan_T_tilt: PoseSlot | Sequence[PoseSlot],
    calibration: Slot | Sequence[Slot],
    tilted_T_head: PoseSlot | Sequence[PoseSlot] | None = None,
    *,
    nominal: FloatArray,
    basis: FloatArray,
    lens: Camera,
    uv_px: FloatArray,
) -> gtsam.CustomFactor:
    """The factor of `mast_projection_residual`: slots of points, poses, pan-tilt and calibration.

    The slot `calibration` has the free entries of a correction of K, which `basis` (n, 5, entries) takes to
    changes of fx, fy, skew, cx and cy of `nominal` (n, 3, 3); no entries where K is fixed. For n observations
    at once, all through one lens, each slot is a sequence of n, and the noise has 2 n rows. Without
    `tilted_T_head` that is the identity.
    """
    row, column = CALIBRATION_ENTRIES

    def residual(
        point: FloatArray,
        mast: Pose,
        pan_tilt: FloatArray,
        mount: Pose,
        axis: Pose,
        entries: FloatArray,
        head: Pose | None = None,
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        K = nominal.copy()
        K[:, row, column] += np.einsum("nij,nj->ni", basis, entries)
        error, by_variables = mast_projection_residual(
            point, mast, pan_tilt, mount, axis, K, lens, uv_px, head
        )
        return error, (*by_variables[:5], by_variables[5] @ basis, *by_variables[6:])

    slots: list[tuple[PoseSlot | Sequence[PoseSlot], Kind]] = [
        (point_m, "point"),
        (world_T_mast, "pose"),
        (pan_tilt_rad, "vector"),
        (head_T_camera, "pose"),
        (pan_T_tilt, "pose"),
        (calibration, "vector"),
    ]
    if tilted_T_head is not None:
        slots.append((tilted_T_head, "pose"))
    return custom_factor(noise, slots, residual)
