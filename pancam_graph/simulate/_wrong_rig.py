"""A rig with errors, as a simulated traverse may claim it beside the true one that made its images."""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import corrected_poses, rz
from pancam_graph.rigs import Rig

__all__ = ["wrong_rig"]


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
            nominal = mount.rotation().matrix(), mount.translation()
            rotation, translation = corrected_poses(*nominal, sigmas * draw[2:])
            mount = gtsam.Pose3(gtsam.Rot3(rotation), translation)
        eyes.append(replace(eye, camera=camera, head_T_camera=mount))
    return replace(rig, eyes=tuple(eyes))
