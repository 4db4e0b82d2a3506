"""Cameras of a rig at given angles, with a mast that stands askew, and what a fit of them leaves free."""

from collections.abc import Sequence

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, ry, rz
from pancam_graph.rigs import (
    Rig,
    RigFit,
    msl_navcam,
)

NAVCAM = msl_navcam()
"""A tilt axis that is neither square to the pan axis nor meets it."""
WORLD_T_MAST = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([0.02, -0.03, 1.1])), np.array([0.8, -0.5, 1.9]))


def turned(angle_rotation: FloatArray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3(angle_rotation), np.zeros(3))


def camera_at(
    world_T_mast: gtsam.Pose3,
    pan_T_tilt: gtsam.Pose3,
    head_T_camera: gtsam.Pose3,
    angles: Sequence[float],
) -> gtsam.Pose3:
    """The chain written out with gtsam's poses, apart from the package's own."""
    pan, tilt = angles
    return world_T_mast * turned(rz(pan)) * pan_T_tilt * turned(ry(-tilt)) * head_T_camera


def cameras_of(
    rig: Rig, angles: FloatArray, eyes: Sequence[str], world_T_mast: gtsam.Pose3 = WORLD_T_MAST
) -> list[gtsam.Pose3]:
    mounts = [rig.eyes[rig.eye_index(e)].head_T_camera for e in eyes]
    return [
        camera_at(world_T_mast, rig.pan_T_tilt, m, a) for m, a in zip(mounts, angles.tolist(), strict=True)
    ]


def angles_of(n: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).uniform([-2.5, -0.9], [2.5, 0.6], (n, 2))


def worst_unseen(fit: RigFit, rig: Rig) -> float:
    """Largest miss, metres or radians, of the fit at pointings that it was not made from."""
    worst = 0.0
    for angles in angles_of(7, seed=99):
        for eye, mount in zip(fit.eyes, fit.head_T_camera, strict=True):
            fitted = camera_at(
                fit.world_T_mast, fit.pan_T_tilt, mount, (angles + fit.angle_offset_rad).tolist()
            )
            (true,) = cameras_of(rig, angles[None], [eye])
            worst = max(worst, float(np.abs(true.localCoordinates(fitted)).max()))
    return worst


def noisy(poses: Sequence[gtsam.Pose3], sigma: float, rng: np.random.Generator) -> list[gtsam.Pose3]:
    """Rotation disturbed in the camera's frame, centre in the world's, independently."""
    return [
        gtsam.Pose3(
            p.rotation() * gtsam.Rot3.Expmap(sigma * rng.standard_normal(3)),
            p.translation() + sigma * rng.standard_normal(3),
        )
        for p in poses
    ]


ALWAYS_FREE = ("zero point of pan", "height", "zero point of tilt", "place along the tilt axis")


def texts(fit: RigFit) -> list[str]:
    return [d.text for d in fit.free_directions]
