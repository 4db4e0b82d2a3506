"""Rigs with errors, as a simulated traverse may claim them beside the true one that made its images."""

from dataclasses import replace

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, corrected_poses, rz
from pancam_graph.cameras import FIELD_PER_COEFFICIENT, FIELD_SHAPE, without_affine
from pancam_graph.rigs import RIG_ENTRIES, Rig, RigEntry

__all__ = ["drawn_encoders", "drawn_fields", "drawn_flex", "drawn_rig", "wrong_rig"]


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
    owners = [(q, eye.name) for eye in rig.eyes for q in ("calibration", "mounts")]
    entries = [RigEntry(q, owner, e) for q, owner in (*owners, ("pan_T_tilt", None)) for e in RIG_ENTRIES[q]]
    covariance = rig.uncertainty.covariance_of(entries)
    size = np.sqrt(np.diag(covariance))
    known = size > 0
    root = np.diag(size)
    root[np.ix_(known, known)] @= np.linalg.cholesky(
        covariance[np.ix_(known, known)] / np.outer(size[known], size[known])
    )
    errors = root @ rng.standard_normal(len(entries))
    eyes = []
    for eye, of_eye in zip(rig.eyes, errors[:-6].reshape(-1, 11), strict=True):
        focal, aspect, skew, cx, cy = of_eye[:5]
        K = eye.camera.pinhole.calibration_matrix
        K[0, 0] *= 1 + focal
        K[1, 1] *= 1 + focal + aspect
        K[0, 1] += skew
        K[:2, 2] += [cx, cy]
        head_T_camera = _corrected(eye.head_T_camera, of_eye[5:])
        eyes.append(replace(eye, camera=eye.camera.with_calibration(K), head_T_camera=head_T_camera))
    return replace(rig, eyes=tuple(eyes), pan_T_tilt=_corrected(rig.pan_T_tilt, errors[-6:]))


def drawn_flex(rig: Rig, n_frames: int, rng: np.random.Generator) -> FloatArray:
    """How heads of frames stand off the joints (frames, 6), as far as the rig's uncertainty says.

    Turns about the pan axis, the tilt axis and the head's forward axis, radians, then shifts along the head's
    own axes, metres.
    """
    sigmas = np.repeat([rig.uncertainty.flex_rad, rig.uncertainty.flex_m], 3)
    return np.asarray(sigmas * rng.standard_normal((n_frames, 6)))


def drawn_encoders(rig: Rig, rng: np.random.Generator) -> FloatArray:
    """What pan and tilt (2,) exceed their readings by, as shares, as far as the rig's uncertainty says."""
    sigmas = np.array([rig.uncertainty.pan_scale, rig.uncertainty.tilt_scale])
    return np.asarray(sigmas * rng.standard_normal(2)) if sigmas.any() else sigmas


def drawn_fields(rig: Rig, rng: np.random.Generator) -> FloatArray:
    """Coefficients (eyes, *FIELD_SHAPE) of smooth fields, as large as the rig's uncertainty says."""
    sigma = rig.uncertainty.field_px / FIELD_PER_COEFFICIENT
    return without_affine(sigma * rng.standard_normal((len(rig.eyes), *FIELD_SHAPE)))


def _corrected(pose: gtsam.Pose3, correction: FloatArray) -> gtsam.Pose3:
    """A pose turned and shifted in its own frame by a correction (6,), rotation first."""
    rotation, translation = corrected_poses(pose.rotation().matrix(), pose.translation(), correction)
    return gtsam.Pose3(gtsam.Rot3(rotation), translation)
