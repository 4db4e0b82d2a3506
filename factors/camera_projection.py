"""Camera projection factor: an observation of a terrain point by a camera of any model (2 rows).

The residual is the point's projection less the measured pixel, in pixels; the noise model whitens it.
Pinholes have GTSAM's own projection factors.
"""

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, skew
from pancam_graph.cameras import CALIBRATION_ENTRIES, Camera
from pancam_graph.factors._slots import Slot, custom_factor
from pancam_graph.factors.mast import Pose

__all__ = ["camera_projection_factor", "camera_projection_residual"]

_OUTSIDE_PX = 1e6
"""Residual in each row for a point that its camera cannot see, so that an optimiser rejects it."""


def camera_projection_residual(
    point_m: FloatArray, world_T_camera: Pose, calibration: FloatArray, lens: Camera, uv_px: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """Residuals (n, 2), pixels, and Jacobians by point, camera and calibration.

    Points (n, 3) are in the world; poses are a pair of rotations (n, 3, 3) and translations (n, 3), their
    Jacobian (n, 2, 6) by body-frame tangents, rotation first. `calibration` (n, 3, 3) is K, its Jacobian
    (n, 2, 5) by fx, fy, skew, cx, cy. `lens` is the camera with a K of 1, which all observations share
    (`Camera.with_unit_calibration`). A point behind its camera, or outside the domain of its lens, has a
    large constant residual, with Jacobians of 0.
    """
    camera_R, camera_t = world_T_camera
    back = np.swapaxes(camera_R, -1, -2)
    seen = (back @ (point_m - camera_t)[..., None])[..., 0]
    xy, d_xy, valid = lens.project_with_jacobian(seen)
    K = calibration
    residual = np.einsum("nij,nj->ni", K[:, :2, :2], xy) + K[:, :2, 2] - uv_px
    d_seen = K[:, :2, :2] @ d_xy
    # A rotation and a translation of the camera in its own frame move the point the other way.
    d_camera = d_seen @ np.concatenate([skew(seen), np.broadcast_to(-np.eye(3), (len(xy), 3, 3))], axis=-1)
    d_calibration = np.zeros((len(xy), 2, 5))
    for column, (row, entry) in enumerate(zip(*CALIBRATION_ENTRIES, strict=True)):
        d_calibration[:, row, column] = 1.0 if entry == 2 else xy[:, entry]
    jacobians = d_seen @ back, d_camera, d_calibration
    residual[~valid] = _OUTSIDE_PX
    for jacobian in jacobians:
        jacobian[~valid] = 0.0
    return residual, jacobians


def camera_projection_factor(
    noise: gtsam.noiseModel.Base,
    point_m: Slot,
    world_T_camera: Slot,
    calibration: Slot,
    *,
    lens: Camera,
    uv_px: FloatArray,
) -> gtsam.CustomFactor:
    """The factor of `camera_projection_residual` for one pixel (2,): slots of Point3, Pose3 and Cal3_S2."""

    def residual(
        point: FloatArray, camera: Pose, entries: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        K = np.zeros((len(entries), 3, 3))
        K[:, CALIBRATION_ENTRIES[0], CALIBRATION_ENTRIES[1]] = entries
        K[:, 2, 2] = 1.0
        return camera_projection_residual(point, camera, K, lens, uv_px[None])

    return custom_factor(
        noise, ((point_m, "point"), (world_T_camera, "pose"), (calibration, "calibration")), residual
    )
