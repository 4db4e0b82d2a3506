"""First values from camera poses of another program, whose world has a gauge and a scale of its own."""

from collections.abc import Mapping

import gtsam
import numpy as np

from pancam_graph.base.errors import GeometryError, InputError
from pancam_graph.base.geometry import FloatArray, IntArray, pose_arrays, so3_log, wrap_angle
from pancam_graph.cameras import projection_matrix
from pancam_graph.data import Traverse
from pancam_graph.initialise._extract import extract_mast
from pancam_graph.initialise._start import Start, mast_by_chain

__all__ = ["start_from_poses"]

_UNLIKE_RAD = 0.5
"""Median angle between given and told cameras from which they are not of one drive."""
_LEAST_SPREAD = 1e-9
"""Variance of given centres, over that of told ones, below which they tell no scale."""


def start_from_poses(traverse: Traverse, other_T_camera: Mapping[int, gtsam.Pose3]) -> Start:
    """Masts and angles from poses of the cameras of some images, by row.

    The other world is turned onto that of the traverse so that cameras look as telemetry says, on the whole;
    where there are several stops it is scaled so that centres are as far apart as told, on the whole. Each
    stop's pan axis follows from its cameras (`extract_mast`), or, where all have one pan, its pose from
    telemetry's angles; pans have the mean that telemetry says. The first stop with poses then stands where it
    is told. Frames and stops without a pose stay as told.

    Raises InputError without a pose, for cameras that look otherwise than telemetry says, and for several
    stops whose centres tell no scale.
    """
    if not other_T_camera:
        raise InputError("start: expected the pose of one camera at least, found none")
    rows = np.array(sorted(other_T_camera), dtype=np.int64)
    other_R_camera, other_centre = pose_arrays([other_T_camera[row] for row in rows.tolist()])
    told_R, told_centre = (a[rows] for a in traverse.camera_poses())
    world_R_other = _mean_rotation(told_R @ other_R_camera.transpose(0, 2, 1))
    world_R_camera = world_R_other @ other_R_camera
    off = np.linalg.norm(so3_log(told_R.transpose(0, 2, 1) @ world_R_camera), axis=1)
    if np.median(off) > _UNLIKE_RAD:
        raise InputError(
            "start: expected cameras that look as telemetry says, but for a turn of all together, within "
            f"{np.rad2deg(_UNLIKE_RAD):.0f} degrees; found them {np.rad2deg(np.median(off)):.0f} degrees off"
        )
    centre = other_centre @ world_R_other.T
    scale = _scale(centre, told_centre, several=len(np.unique(traverse.image_stop[rows])) > 1)
    masts = [stop.world_T_mast for stop in traverse.stops]
    angles = traverse.pan_tilt_rad.copy()
    moved: gtsam.Pose3 | None = None
    for stop in range(len(masts)):
        here = np.flatnonzero(traverse.image_stop[rows] == stop)
        if not len(here):
            continue
        mast, found = _mast(traverse, rows[here], world_R_camera[here], scale * centre[here])
        if moved is None:
            moved = masts[stop] * mast.inverse()
        masts[stop] = moved * mast
        frames = traverse.image_frame[rows[here]]
        angles[frames] = angles[frames] + wrap_angle(found - angles[frames])
    return Start(world_T_mast=tuple(masts), pan_tilt_rad=angles)


def _mean_rotation(rotations: FloatArray) -> FloatArray:
    """The rotation nearest to all of (n, 3, 3)."""
    u, _, vt = np.linalg.svd(rotations.sum(axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _scale(centre: FloatArray, told_centre: FloatArray, *, several: bool) -> float:
    """Metres of the world per unit of the other. Raises InputError where several stops tell none."""
    if not several:
        return 1.0
    apart, told_apart = centre - centre.mean(axis=0), told_centre - told_centre.mean(axis=0)
    spread = float(np.sum(apart**2))
    along = float(np.sum(apart * told_apart))
    if spread <= _LEAST_SPREAD * float(np.sum(told_apart**2)) or along <= 0:
        raise InputError(
            "start: expected cameras whose stops lie to each other as told, but for a scale; found "
            f"{'all at one place' if along == 0 else 'them elsewhere'}"
        )
    return along / spread


def _mast(
    traverse: Traverse, rows: IntArray, world_R_camera: FloatArray, centre: FloatArray
) -> tuple[gtsam.Pose3, FloatArray]:
    """The mast of a stop from its cameras, and pans and tilts (n, 2) of these."""
    rig, eye = traverse.rig, traverse.image_eye[rows]
    told = traverse.pan_tilt_rad[traverse.image_frame[rows]]
    K = np.array([rig.eyes[k].camera.pinhole.calibration_matrix for k in eye])
    try:
        cameras = extract_mast(
            projection_matrix(K, world_R_camera.transpose(0, 2, 1), centre),
            rig,
            [rig.eyes[k].name for k in eye],
            first_pan_rad=float(told[0, 0]),
        )
    except GeometryError:
        return mast_by_chain(traverse, rows, world_R_camera, centre), told
    found = cameras.pan_tilt_rad
    ahead = float(np.mean(wrap_angle(told[:, 0] - found[:, 0])))
    turned = cameras.world_T_mast * gtsam.Pose3(gtsam.Rot3.Rz(-ahead), np.zeros(3))
    return turned, found + np.array([ahead, 0.0])
