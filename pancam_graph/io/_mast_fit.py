"""Fit of a mast's chain to the cameras that labels give: axes, angles and mounts."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pancam_graph.geometry import FloatArray, IntArray, compose, pan_tilt_rotation

__all__ = ["LabelCameras", "MastFit", "fit_angles", "fit_mast", "label_misfit"]

_LABEL_SIGMA = 1e-5
"""Metres and radians; labels print six digits."""
_AXIS_SIGMA = np.array([5e-3] * 2 + [5e-3] * 3 + [5e-3] * 2 + [5e-3])
"""Radians and metres by which a mast's axes may differ from its design: weak, only to settle what the
labels leave open."""
_ANGLE_SIGMA_RAD = 5e-3
_FIT_FRAMES = 24
"""Axes need no more; the angles of all frames are fitted afterwards."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelCameras:
    """Camera poses of n images as their labels give them, z-up rover frame."""

    rotation: FloatArray
    """(n, 3, 3) rover_R_camera."""
    centre_m: FloatArray
    """(n, 3) in the rover frame."""
    frame: IntArray
    """(n,) row of each image's frame."""
    eye: IntArray
    """(n,) row of each image's eye."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MastFit:
    """A chain: axes, mounts and the angles of all frames."""

    rover_T_mast: gtsam.Pose3
    pan_T_tilt: gtsam.Pose3
    mount_R: FloatArray
    """(eyes, 3, 3) head_R_camera."""
    mount_t: FloatArray
    """(eyes, 3) metres, in the head frame."""
    pan_tilt_rad: FloatArray
    """(frames, 2)."""

    def rover_T_camera(self, frame: IntArray, eye: IntArray) -> tuple[FloatArray, FloatArray]:
        """Camera poses of images in the rover frame: rotations (n, 3, 3), centres (n, 3)."""
        pan, tilt = self.pan_tilt_rad[frame].T
        zero = np.zeros_like(pan)
        to_pan = compose(
            self.rover_T_mast.rotation().matrix(),
            self.rover_T_mast.translation(),
            pan_tilt_rotation(pan, zero),
            np.zeros((len(pan), 3)),
        )
        to_tilt = compose(*to_pan, self.pan_T_tilt.rotation().matrix(), self.pan_T_tilt.translation())
        to_head = compose(*to_tilt, pan_tilt_rotation(zero, tilt), np.zeros((len(pan), 3)))
        return compose(*to_head, self.mount_R[eye], self.mount_t[eye])


def label_misfit(fit: MastFit, labels: LabelCameras) -> FloatArray:
    """What the chain misses each label by, (n, 6): rotation vector (radians), centre (metres)."""
    rotation, centre = fit.rover_T_camera(labels.frame, labels.eye)
    turn = Rotation.from_matrix(np.swapaxes(labels.rotation, -1, -2) @ rotation).as_rotvec()
    return np.column_stack([turn, centre - labels.centre_m])


def fit_angles(fit: MastFit, labels: LabelCameras) -> MastFit:
    """Each frame's pan and tilt that fit its labels' cameras best, all else held (Gauss-Newton)."""
    frames = len(fit.pan_tilt_rad)
    step = 1e-6
    for _ in range(6):
        residual = label_misfit(fit, labels)
        jacobian = np.stack(
            [
                (label_misfit(replace(fit, pan_tilt_rad=fit.pan_tilt_rad + d), labels) - residual) / step
                for d in (np.array([step, 0.0]), np.array([0.0, step]))
            ],
            axis=-1,
        )
        normal, right = np.zeros((frames, 2, 2)), np.zeros((frames, 2))
        np.add.at(normal, labels.frame, np.einsum("nki,nkj->nij", jacobian, jacobian))
        np.add.at(right, labels.frame, np.einsum("nki,nk->ni", jacobian, residual))
        # A head that looks along the pan axis leaves pan open: then it stays.
        change = -np.einsum("nij,nj->ni", np.linalg.pinv(normal, rcond=1e-9), right)
        fit = replace(fit, pan_tilt_rad=fit.pan_tilt_rad + change)
        if np.abs(change).max() < 1e-12:
            break
    return fit


def fit_mast(fit: MastFit, labels: LabelCameras) -> MastFit:
    """Fit axes, mounts and angles to the labels' cameras, starting from `fit`.

    The axes' design and the measured angles (those of `fit`) count as weak observations, 5 mm and
    5 mrad, against 0.01 mm and 0.01 mrad of the labels, so that whatever the labels leave open (few
    frames, one tilt) stays where it was.
    """
    frames = len(fit.pan_tilt_rad)
    chosen = np.unique(np.linspace(0, frames - 1, min(frames, _FIT_FRAMES)).round().astype(np.int64))
    # Every eye must be seen, or its mount would not be fitted.
    seen = [int(labels.frame[labels.eye == e][0]) for e in range(len(fit.mount_R))]
    chosen = np.unique(np.concatenate([chosen, np.array(seen, dtype=np.int64)]))
    used = np.isin(labels.frame, chosen)
    part = LabelCameras(
        rotation=labels.rotation[used],
        centre_m=labels.centre_m[used],
        frame=np.searchsorted(chosen, labels.frame[used]).astype(np.int64),
        eye=labels.eye[used],
    )
    start = replace(fit, pan_tilt_rad=fit.pan_tilt_rad[chosen])

    def residual(x: FloatArray) -> FloatArray:
        axes, angles = x[:8], x[8 : 8 + 2 * len(chosen)]
        labels_part = label_misfit(_moved(start, x), part).ravel() / _LABEL_SIGMA
        return np.concatenate([labels_part, axes / _AXIS_SIGMA, angles / _ANGLE_SIGMA_RAD])

    x0 = np.zeros(8 + 2 * len(chosen) + 6 * len(fit.mount_R))
    solution = least_squares(residual, x0, method="trf", x_scale=1e-3, xtol=1e-10, ftol=1e-10, gtol=1e-10)
    moved = _moved(start, solution.x)
    return fit_angles(replace(moved, pan_tilt_rad=fit.pan_tilt_rad), labels)


def _moved(fit: MastFit, x: FloatArray) -> MastFit:
    """`fit` moved by x: mast (turn x y, shift x y z), tilt axis (turn x z, shift x), angles, mounts.

    What is left out is undone by something else: a turn of the mast about z by pan, a shift of the
    tilt axis along itself or of both origins by the mounts.
    """
    frames, eyes = len(fit.pan_tilt_rad), len(fit.mount_R)
    mast = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([x[0], x[1], 0.0])), x[2:5])
    tilt = gtsam.Pose3(gtsam.Rot3.Expmap(np.array([x[5], 0.0, x[6]])), np.array([x[7], 0.0, 0.0]))
    angles = x[8 : 8 + 2 * frames].reshape(frames, 2)
    mounts = x[8 + 2 * frames :].reshape(eyes, 6)
    return MastFit(
        rover_T_mast=fit.rover_T_mast.compose(mast),
        pan_T_tilt=fit.pan_T_tilt.compose(tilt),
        mount_R=fit.mount_R @ Rotation.from_rotvec(mounts[:, :3]).as_matrix(),
        mount_t=fit.mount_t + mounts[:, 3:],
        pan_tilt_rad=fit.pan_tilt_rad + angles,
    )
