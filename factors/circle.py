"""Circle factor: a camera's centre lies on a circle about the pan axis (3 rows), thesis eq. 4.8.

    C = R [rho cos(phi), rho sin(phi), h]^T + Cc

R and Cc are the orientation and the centre of the circle; h is 0 in the thesis. Here the pose of the circle
is that of the mast, whose z axis is the pan axis. So one pose is enough for all eyes and tilts: the circle of
an eye lies h above the origin of the mast, and phi is the pan plus the phase of the eye. The rotation of the
camera is free.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.geometry import FloatArray, skew
from pancam_graph.factors._slots import Slot, custom_factor

__all__ = ["CircleOffset", "circle_factor", "circle_residual"]


@dataclass(frozen=True, kw_only=True)
class CircleOffset:
    """Known constants of images' circles, from the rig and the measured tilt: numbers, or arrays (n,)."""

    height_m: ArrayLike = 0.0
    """Height h of the circle's plane above the mast's origin."""
    phase_rad: ArrayLike = 0.0
    """Added to the pan to give phi."""
    radius_m: ArrayLike = 0.0
    """Added to the estimated radius, which belongs to the eye at its reference tilt."""


def circle_residual(
    world_T_camera: tuple[FloatArray, FloatArray],
    world_T_circle: tuple[FloatArray, FloatArray],
    radius_m: ArrayLike,
    angle_rad: ArrayLike,
    offset: CircleOffset,
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Residuals (..., 3), metres in the circle's frame, and their Jacobians.

    By camera pose (..., 3, 6) and circle pose (..., 3, 6), body-frame tangents with rotation first, by radius
    (..., 3, 1) and by angle (..., 3, 1). A radius of 0 makes the angle's Jacobian vanish: the angle is then
    undetermined, and its prior must hold it.
    """
    camera_R, camera_t = world_T_camera
    circle_R, circle_t = world_T_circle
    rho = np.asarray(np.add(radius_m, offset.radius_m), dtype=float)
    phi = np.asarray(np.add(angle_rad, offset.phase_rad), dtype=float)
    zero = np.zeros_like(phi)
    outward = np.stack([np.cos(phi), np.sin(phi), zero], axis=-1)
    onward = np.stack([-np.sin(phi), np.cos(phi), zero], axis=-1)
    back = np.swapaxes(circle_R, -1, -2)
    centre = (back @ (camera_t - circle_t)[..., None])[..., 0]
    residual = centre - rho[..., None] * outward
    residual[..., 2] -= offset.height_m
    along = np.broadcast_to(-np.eye(3), (*centre.shape, 3))
    d_camera = np.concatenate([np.zeros_like(along), back @ camera_R], axis=-1)
    d_circle = np.concatenate([skew(centre), along], axis=-1)
    return residual, (d_camera, d_circle, -outward[..., None], -(rho[..., None] * onward)[..., None])


def circle_factor(
    noise: gtsam.noiseModel.Base,
    world_T_camera: Slot | Sequence[Slot],
    world_T_circle: Slot | Sequence[Slot],
    radius_m: Slot | Sequence[Slot],
    pan_tilt_rad: Slot | Sequence[Slot],
    offset: CircleOffset,
) -> gtsam.CustomFactor:
    """The factor of `circle_residual`: slots of Pose3, Pose3, double, vector whose first entry is the pan.

    For n images at once each slot is a sequence of n, and the noise has 3 n rows.
    """

    def residual(
        camera: tuple[FloatArray, FloatArray],
        circle: tuple[FloatArray, FloatArray],
        radius_m: FloatArray,
        pan_tilt: FloatArray,
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        error, (*others, d_angle) = circle_residual(camera, circle, radius_m, pan_tilt[:, 0], offset)
        d_pan_tilt = np.zeros((*error.shape, pan_tilt.shape[1]))
        d_pan_tilt[..., 0] = d_angle[..., 0]
        return error, (*others, d_pan_tilt)

    return custom_factor(
        noise,
        (
            (world_T_camera, "pose"),
            (world_T_circle, "pose"),
            (radius_m, "number"),
            (pan_tilt_rad, "vector"),
        ),
        residual,
    )
