"""Circle factor: a camera's centre lies on a circle about the pan axis (3 rows), thesis eq. 4.8.

    C = R [rho cos(phi), rho sin(phi), h]^T + Cc

R and Cc are the circle's orientation and centre; h is 0 in the thesis. Here the circle's pose is the
mast's, whose z is the pan axis, so that one pose serves every eye at every tilt: an eye's circle lies h
above the mast's origin, and phi is the pan plus the eye's phase. The camera's rotation is free.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from pancam_graph.factors._slots import Slot, custom_factor
from pancam_graph.geometry import FloatArray, skew

__all__ = ["CircleOffset", "circle_factor", "circle_residual"]


@dataclass(frozen=True, kw_only=True)
class CircleOffset:
    """Known constants of one image's circle, from the rig and the measured tilt."""

    height_m: float = 0.0
    """h: of the circle's plane above the mast's origin."""
    phase_rad: float = 0.0
    """Added to the pan to give phi."""
    radius_m: float = 0.0
    """Added to the estimated radius, which belongs to the eye at its reference tilt."""


def circle_residual(
    world_T_camera: tuple[FloatArray, FloatArray],
    world_T_circle: tuple[FloatArray, FloatArray],
    radius_m: float,
    angle_rad: float,
    offset: CircleOffset,
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Residual (3,), metres in the circle's frame, and its Jacobians.

    By camera pose (3, 6) and circle pose (3, 6), body-frame tangents with rotation first, by radius
    (3, 1) and by angle (3, 1). A radius of 0 makes the angle's Jacobian vanish: the angle is then
    undetermined, and its prior must hold it.
    """
    camera_R, camera_t = world_T_camera
    circle_R, circle_t = world_T_circle
    rho, phi = radius_m + offset.radius_m, angle_rad + offset.phase_rad
    outward = np.array([np.cos(phi), np.sin(phi), 0.0])
    onward = np.array([-np.sin(phi), np.cos(phi), 0.0])
    centre = circle_R.T @ (camera_t - circle_t)
    residual = centre - rho * outward
    residual[2] -= offset.height_m
    d_camera = np.concatenate([np.zeros((3, 3)), circle_R.T @ camera_R], axis=1)
    d_circle = np.concatenate([skew(centre), -np.eye(3)], axis=1)
    return residual, (d_camera, d_circle, -outward[:, None], -rho * onward[:, None])


def circle_factor(
    noise: gtsam.noiseModel.Base,
    world_T_camera: Slot,
    world_T_circle: Slot,
    radius_m: Slot,
    pan_tilt_rad: Slot,
    offset: CircleOffset,
) -> gtsam.CustomFactor:
    """The factor of `circle_residual`: slots of Pose3, Pose3, double, vector whose first entry is the pan."""

    def residual(
        camera: gtsam.Pose3, circle: gtsam.Pose3, radius: float, pan_tilt: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        error, (d_camera, d_circle, d_radius, d_angle) = circle_residual(
            (camera.rotation().matrix(), camera.translation()),
            (circle.rotation().matrix(), circle.translation()),
            radius,
            float(pan_tilt[0]),
            offset,
        )
        d_pan_tilt = np.zeros((3, len(pan_tilt)))
        d_pan_tilt[:, 0] = d_angle[:, 0]
        return error, (d_camera, d_circle, d_radius, d_pan_tilt)

    slots = [
        (world_T_camera, gtsam.Values.atPose3),
        (world_T_circle, gtsam.Values.atPose3),
        (radius_m, gtsam.Values.atDouble),
        (pan_tilt_rad, gtsam.Values.atVector),
    ]
    return custom_factor(noise, slots, residual)
