"""Rigs with errors, as a simulated traverse may claim them beside the true one that made its images."""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, corrected_poses, rz
from pancam_graph.rigs import Rig

__all__ = ["drawn_flex", "drawn_rig", "wrong_rig"]


def wrong_rig(
    rig: Rig,
    rng: np.random.Generator,
    *,
    focal: float,
    mount_rad: float,
    mount_m: float,
    radius_m: float,
    tilt_rad: float,
) -> Rig:
    """The rig with gaussian errors in each eye, drawn independently, of the given standard deviations.

    `focal` is of a factor on the focal length, `mount_rad` and `mount_m` of each component of the mount's
    correction (geometry.corrected_poses), `radius_m` of the radius of its circle at the tilt `tilt_rad`.
    """
    head_R, _ = rig.mast_T_head(np.zeros(1), np.array([tilt_rad]))
    draws = rng.standard_normal((len(rig.eyes), 8))
    sigmas = np.repeat([mount_rad, mount_m], 3)
    eyes = []
    for i, (eye, draw) in enumerate(zip(rig.eyes, draws, strict=True)):
        camera, mount = eye.camera, eye.head_T_camera
        if focal:
            calibration = camera.pinhole.calibration_matrix
            calibration[:2, :2] *= 1 + focal * draw[0]
            camera = camera.with_calibration(calibration)
        if radius_m:
            _, phase_rad, _ = rig.circle(i, tilt_rad)
            shift = radius_m * draw[1] * (head_R[0].T @ rz(phase_rad)[:, 0])
            mount = gtsam.Pose3(mount.rotation(), mount.translation() + shift)
        if sigmas.any():
            mount = _corrected(mount, sigmas * draw[2:])
        eyes.append(replace(eye, camera=camera, head_T_camera=mount))
    return replace(rig, eyes=tuple(eyes))


def drawn_rig(rig: Rig, rng: np.random.Generator) -> Rig:
    """The rig with gaussian errors in all its numbers, as large as its own uncertainty says."""
    u = rig.uncertainty
    turn_shift = np.repeat([u.mount_rad, u.mount_m], 3)
    eyes = []
    for eye in rig.eyes:
        focal, aspect, skew, cx, cy, *mount = rng.standard_normal(11)
        K = eye.camera.pinhole.calibration_matrix
        K[0, 0] *= 1 + u.focal * focal
        K[1, 1] *= 1 + u.focal * focal + u.aspect * aspect
        K[0, 1] += u.skew_px * skew
        K[:2, 2] += u.principal_point_px * np.array([cx, cy])
        head_T_camera = _corrected(eye.head_T_camera, turn_shift * mount)
        eyes.append(replace(eye, camera=eye.camera.with_calibration(K), head_T_camera=head_T_camera))
    axis = np.repeat([u.tilt_axis_rad, u.tilt_axis_m], 3) * rng.standard_normal(6)
    return replace(rig, eyes=tuple(eyes), pan_T_tilt=_corrected(rig.pan_T_tilt, axis))


def drawn_flex(rig: Rig, n_frames: int, rng: np.random.Generator) -> FloatArray:
    """How heads of frames stand off the joints (frames, 6), as far as the rig's uncertainty says.

    Turns about the pan axis, the tilt axis and the head's forward axis, radians, then shifts along the head's
    own axes, metres.
    """
    sigmas = np.repeat([rig.uncertainty.flex_rad, rig.uncertainty.flex_m], 3)
    return np.asarray(sigmas * rng.standard_normal((n_frames, 6)))


def _corrected(pose: gtsam.Pose3, correction: FloatArray) -> gtsam.Pose3:
    """A pose turned and shifted in its own frame by a correction (6,), rotation first."""
    rotation, translation = corrected_poses(pose.rotation().matrix(), pose.translation(), correction)
    return gtsam.Pose3(gtsam.Rot3(rotation), translation)
