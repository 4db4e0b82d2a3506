"""Parameters of each model from camera matrices, and camera matrices from them (thesis 5.1, 4.2 to 4.9).

A projection matrix is defined up to a factor. Matrices returned here have a third row whose first three
entries have norm 1, and the camera is not mirrored. The parameters of the model `projective` are the entries
of such a matrix.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import CameraError, GeometryError, InputError
from pancam_graph.base.geometry import FloatArray, IntArray, compose, pose_arrays
from pancam_graph.cameras import decompose_projection, projection_matrix
from pancam_graph.initialise._circle import CircleFit, fit_circle
from pancam_graph.rigs import Rig

__all__ = [
    "CircleCameras",
    "FreeCameras",
    "MastCameras",
    "extract_circle",
    "extract_free",
    "extract_mast",
    "head_tilt_rad",
    "mast_pan_rad",
]

_ONE_PAN = 1e-4
"""Spread of pan, radians, below which rounding hides the pan axis."""
_AXIS_STEPS = 20
"""Largest number of Gauss-Newton steps for the pan axis."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeCameras:
    """Parameters of the model `free`: K, orientation and centre of each camera (thesis eq. 4.5)."""

    calibration: FloatArray
    """(n, 3, 3) upper-triangular K, its diagonal above 0, the last entry 1"""
    world_R_camera: FloatArray
    """(n, 3, 3) orientation of each camera"""
    centre_m: FloatArray
    """(n, 3) centre of each camera in the world, metres"""

    @property
    def projections(self) -> FloatArray:
        """Camera matrices (n, 3, 4)."""
        return projection_matrix(self.calibration, self.world_R_camera.transpose(0, 2, 1), self.centre_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class CircleCameras:
    """Parameters of the model `circle`: centres on a circle by their angles, orientations free (eq. 4.9)."""

    calibration: FloatArray
    """(n, 3, 3) calibration matrix K of each camera"""
    world_R_camera: FloatArray
    """(n, 3, 3) orientation of each camera"""
    circle: CircleFit
    """Pose and radius of the circle, the angle of each camera on it, and the residuals of the given
    centres."""

    @property
    def centre_m(self) -> FloatArray:
        """(n, 3) on the circle, thesis eq. 4.8."""
        phi = self.circle.angle_rad
        arm = self.circle.radius_m * np.column_stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)])
        return np.asarray(arm @ self.circle.rotation.T + self.circle.centre_m)

    @property
    def projections(self) -> FloatArray:
        """Camera matrices (n, 3, 4) with their centres on the circle."""
        return projection_matrix(self.calibration, self.world_R_camera.transpose(0, 2, 1), self.centre_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class MastCameras:
    """Parameters of the model `mast` for cameras of one stop: mast pose, and pan and tilt of each camera."""

    rig: Rig
    eye: IntArray
    """(n,) index of each camera's eye in the rig"""
    calibration: FloatArray
    """(n, 3, 3) calibration matrix K of each camera"""
    world_T_mast: gtsam.Pose3
    pan_tilt_rad: FloatArray
    """(n, 2) of each camera; the eyes of one frame may differ"""
    residual_rad: FloatArray
    """(n, 3) rotation from the chain's camera to the given one, rotation vectors in the camera's frame"""
    residual_m: FloatArray
    """(n, 3) shift from the chain's centre to the given one, in the camera's frame"""

    @cached_property
    def _poses(self) -> tuple[FloatArray, FloatArray]:
        return _on_mast(self.rig, self.eye, self.world_T_mast, self.pan_tilt_rad)

    @property
    def world_R_camera(self) -> FloatArray:
        """(n, 3, 3) of the pan-tilt chain."""
        return self._poses[0]

    @property
    def centre_m(self) -> FloatArray:
        """(n, 3) of the pan-tilt chain, in the world."""
        return self._poses[1]

    @property
    def projections(self) -> FloatArray:
        """Camera matrices (n, 3, 4) of cameras on the chain."""
        return projection_matrix(self.calibration, self.world_R_camera.transpose(0, 2, 1), self.centre_m)


def extract_free(projections: ArrayLike, names: Sequence[str] | None = None) -> FreeCameras:
    """K, orientation and centre of cameras from their matrices (n, 3, 4), each up to a factor of either sign.

    Errors call the cameras by `names`. Raises CameraError for a matrix that is no camera: not finite, a zero
    third row, a left block of rank below 3; InputError for another shape.
    """
    matrices = float_array("camera matrices", projections)
    if matrices.ndim != 3 or matrices.shape[1:] != (3, 4) or len(matrices) == 0:
        raise InputError(f"camera matrices: expected shape (n, 3, 4), found {matrices.shape}")
    called = names if names is not None else [f"camera {i}" for i in range(len(matrices))]
    cameras = [_decomposed(matrix, name) for matrix, name in zip(matrices, called, strict=True)]
    calibration, camera_R_world, centre = (np.array(part) for part in zip(*cameras, strict=True))
    return FreeCameras(
        calibration=calibration, world_R_camera=camera_R_world.transpose(0, 2, 1), centre_m=centre
    )


def _decomposed(projection: FloatArray, name: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    try:
        return decompose_projection(projection)
    except CameraError as error:
        raise CameraError(f"{name}: {error}") from error


def extract_circle(projections: ArrayLike, up: FloatArray | None = None) -> CircleCameras:
    """Fit the circle on which the centres of cameras (n, 3, 4) of one eye at one tilt lie.

    `up` (3,) chooses the sense of the circle's normal; default: the mean upward direction of the images.
    Angles count from the first camera. Raises as `extract_free` does, and GeometryError for centres that
    determine no circle: fewer than three, coincident or collinear ones.
    """
    cameras = extract_free(projections)
    above = -cameras.world_R_camera[:, :, 1].sum(axis=0) if up is None else float_array("up", up)
    return CircleCameras(
        calibration=cameras.calibration,
        world_R_camera=cameras.world_R_camera,
        circle=fit_circle(cameras.centre_m, above),
    )


def extract_mast(
    projections: ArrayLike, rig: Rig, eyes: Sequence[str], *, first_pan_rad: float = 0.0
) -> MastCameras:
    """Mast pose, pan and tilt of cameras (n, 3, 4) of one stop on a known rig, their eyes by name.

    Tilt axis and pan axis enclose a fixed angle, so cameras at two or more pans determine the pan axis at any
    tilts. Orientations then determine pan and tilt, and centres the position. A rotation of the mast about
    its z axis is equivalent to an offset of all pans: `first_pan_rad` fixes it.

    Raises as `extract_free` does; InputError for an eye that the rig does not have or a wrong number of eyes;
    GeometryError where all cameras have one pan.
    """
    cameras = extract_free(projections)
    if len(eyes) != len(cameras.centre_m):
        raise InputError(f"eyes: expected one for each of {len(cameras.centre_m)} cameras, found {len(eyes)}")
    eye = np.array([rig.eye_index(name) for name in eyes], dtype=np.int64)
    mounts_R, _ = pose_arrays([e.head_T_camera for e in rig.eyes])
    world_R_head = cameras.world_R_camera @ mounts_R[eye].transpose(0, 2, 1)

    z = _pan_axis(rig, world_R_head)
    x = world_R_head[0, :, 0] - (world_R_head[0, :, 0] @ z) * z
    if np.linalg.norm(x) < 1e-6:  # the camera looks along the pan axis: its y axis serves instead
        x = np.cross(world_R_head[0, :, 1], z)
    x /= np.linalg.norm(x)
    world_R_mast = np.column_stack([x, np.cross(z, x), z])
    turn = mast_pan_rad(rig, world_R_mast.T @ world_R_head[0, :, 1]) - first_pan_rad
    back = gtsam.Rot3.Rz(turn).matrix()
    world_R_mast = world_R_mast @ back
    angles = np.array(
        [
            [mast_pan_rad(rig, world_R_mast.T @ head[:, 1]), head_tilt_rad(rig, head.T @ z)]
            for head in world_R_head
        ]
    )
    _, mast_t_camera = rig.mast_T_camera(angles, eye)
    at = (cameras.centre_m - mast_t_camera @ world_R_mast.T).mean(axis=0)
    world_T_mast = gtsam.Pose3(gtsam.Rot3(world_R_mast), at)
    chain_R, chain_t = _on_mast(rig, eye, world_T_mast, angles)
    left = chain_R.transpose(0, 2, 1) @ cameras.world_R_camera
    shift = np.einsum("nji,nj->ni", chain_R, cameras.centre_m - chain_t)
    return MastCameras(
        rig=rig,
        eye=eye,
        calibration=cameras.calibration,
        world_T_mast=world_T_mast,
        pan_tilt_rad=angles,
        residual_rad=np.array([gtsam.Rot3.Logmap(gtsam.Rot3(turn)) for turn in left]),
        residual_m=shift,
    )


def _on_mast(
    rig: Rig, eye: IntArray, world_T_mast: gtsam.Pose3, pan_tilt_rad: FloatArray
) -> tuple[FloatArray, FloatArray]:
    mast_R, mast_t = pose_arrays([world_T_mast])
    return compose(mast_R, mast_t, *rig.mast_T_camera(pan_tilt_rad, eye))


def _pan_axis(rig: Rig, world_R_head: FloatArray) -> FloatArray:
    """The mast's z axis (3,) in the world from head orientations (n, 3, 3).

    Tilt leaves the head's y axis y_i unchanged, and pan preserves its angle to z: the product z . y_i is the
    same for all i, and the rig gives its value. The sense of z is that of the heads' mean z axis.
    """
    y, height = world_R_head[:, :, 1], float(rig.pan_T_tilt.rotation().matrix()[2, 1])
    _, spread, axes = np.linalg.svd(y, full_matrices=True)
    if len(spread) < 2 or spread[1] < _ONE_PAN * np.sqrt(len(y)):
        raise GeometryError(
            f"mast: expected cameras at two pans or more, found {len(y)} at one (or half a turn apart); "
            "no pan axis is determined"
        )
    z = np.asarray(axes[2])
    z = z * (np.sign(z @ world_R_head[:, :, 2].sum(axis=0)) or 1.0)
    for _ in range(_AXIS_STEPS):
        # Least squares on the sphere: a step in the plane across z.
        across = np.linalg.svd(z[None])[2][1:]
        step, *_ = np.linalg.lstsq(y @ across.T, height - y @ z, rcond=None)
        z = z + step @ across
        z /= np.linalg.norm(z)
        if np.linalg.norm(step) < 1e-15:
            break
    return z


def head_tilt_rad(rig: Rig, head_up: FloatArray) -> float:
    """Tilt from the mast's z axis (3,) in the head frame, which pan does not turn."""
    axis_up = rig.pan_T_tilt.rotation().matrix()[2]
    return float(np.arctan2(head_up[0], head_up[2]) - np.arctan2(axis_up[0], axis_up[2]))


def mast_pan_rad(rig: Rig, mast_left: FloatArray) -> float:
    """Pan from the head's y axis (3,) in the mast frame, which tilt does not turn."""
    axis_left = rig.pan_T_tilt.rotation().matrix()[:, 1]
    return float(np.arctan2(mast_left[1], mast_left[0]) - np.arctan2(axis_left[1], axis_left[0]))
