"""Projective factor: a projection matrix is tied to the mast as a camera of the rig (12 rows).

The matrix is decomposed, P = s K R [I | -C]. The rows compare R and C with the chain (`mast_residual`, 6
rows, radians and metres), K with that of the rig (fx, fy, skew, cx, cy, pixels), and s with 1 (its
logarithm). Images do not depend on s: the last row alone determines it.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CALIBRATION_ENTRIES, Conditioning, projection_tangents, split_projections
from pancam_graph.factors._slots import PoseSlot, Slot, custom_factor
from pancam_graph.factors.mast import Pose, mast_residual

__all__ = ["projective_factor", "projective_residual"]

_NO_CAMERA = 1e6
"""Residual in each row for a matrix that is no camera, so that an optimiser rejects it."""


def projective_residual(
    projections: FloatArray,
    world_T_mast: Pose,
    pan_tilt_rad: FloatArray,
    head_T_camera: Pose,
    pan_T_tilt: Pose,
    calibration: FloatArray,
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Residuals (n, 12), Jacobians by P (n, 12, 12), mast (n, 12, 6), pan-tilt (n, 12, 2), mount, axis.

    P (n, 3, 4) take homogeneous points of the world to pixels; poses are pairs of rotations (n, 3, 3) and
    translations (n, 3), `calibration` (n, 3, 3) is the rig's K. P's entries count row by row, other Jacobians
    are by body-frame tangents. A matrix that is no camera (left block of rank below 3) has a large constant
    residual, with Jacobians of 0.
    """
    K, R, C, s = split_projections(projections)
    with np.errstate(all="ignore"):  # as `split_projections`
        pose, (d_camera, *others) = mast_residual(
            (R.transpose(0, 2, 1), C), world_T_mast, pan_tilt_rad, head_T_camera, pan_T_tilt
        )
        numbers = (K - calibration)[:, CALIBRATION_ENTRIES[0], CALIBRATION_ENTRIES[1]]
        residual = np.concatenate([pose, numbers, np.log(s)[:, None]], axis=1)
        d_projection = projection_tangents(K, R, C, s)
        d_projection[:, :6] = d_camera @ d_projection[:, :6]
    jacobians = [d_projection, *(np.pad(d, ((0, 0), (0, 6), (0, 0))) for d in others)]
    lost = ~np.isfinite(residual).all(axis=1)
    residual[lost] = _NO_CAMERA
    for jacobian in jacobians:
        jacobian[lost] = 0.0
    d_mast, d_pan_tilt, d_mount, d_axis = jacobians[1:]
    return residual, (d_projection, d_mast, d_pan_tilt, d_mount, d_axis)


def projective_factor(
    noise: gtsam.noiseModel.Base,
    entries: Slot | Sequence[Slot],
    world_T_mast: Slot | Sequence[Slot],
    pan_tilt_rad: Slot | Sequence[Slot],
    head_T_camera: PoseSlot | Sequence[PoseSlot],
    pan_T_tilt: PoseSlot | Sequence[PoseSlot],
    calibration: FloatArray,
    conditioning: Conditioning,
) -> gtsam.CustomFactor:
    """The factor of `projective_residual`: slots of a vector of 12, Pose3, vector of 2, Pose3, Pose3.

    The vectors have the entries of a conditioned P. For n images at once each slot is a sequence of n;
    `calibration` (n, 3, 3) and `conditioning` are of these, and the noise has 12 n rows.
    """
    d_undo, origin_m = conditioning.d_undo, conditioning.origin_m

    def residual(
        entries: FloatArray, mast: Pose, pan_tilt: FloatArray, mount: Pose, axis: Pose
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        mast = mast[0], mast[1] - origin_m
        error, (d_projection, *others) = projective_residual(
            conditioning.undo(entries), mast, pan_tilt, mount, axis, calibration
        )
        return error, (d_projection @ d_undo, *others)

    return custom_factor(
        noise,
        (
            (entries, "vector"),
            (world_T_mast, "pose"),
            (pan_tilt_rad, "vector"),
            (head_T_camera, "pose"),
            (pan_T_tilt, "pose"),
        ),
        residual,
    )
