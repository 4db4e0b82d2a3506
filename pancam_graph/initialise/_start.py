"""Initial mast poses, angles and cameras of a solve."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import GeometryError, InputError
from pancam_graph.base.geometry import FloatArray, IntArray, pose_arrays, wrap_angle
from pancam_graph.data import Traverse
from pancam_graph.initialise._circle import fit_circle
from pancam_graph.initialise._extract import FreeCameras, extract_free, head_tilt_rad, mast_pan_rad

__all__ = [
    "Start",
    "in_turns_of_telemetry",
    "mast_by_chain",
    "start_from_cameras",
    "start_from_odometry",
    "start_from_telemetry",
]

_ONE_TILT_RAD = 0.01
"""Frames whose tilts differ by less share a circle: encoders repeat to a tenth of that."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Start:
    """First values of a solve; priors stay where the traverse has them."""

    world_T_mast: tuple[gtsam.Pose3, ...]
    """Mast pose of each stop."""
    pan_tilt_rad: FloatArray
    """(frames, 2) pan and tilt."""
    cameras: FreeCameras | None = None
    """Initial cameras of all images for the models `free`, which takes their poses with the rig's
    calibration, and `projective`. None, and in the other models: cameras follow from masts and angles."""
    warnings: tuple[str, ...] = ()
    """Sentences for the user."""

    def __post_init__(self) -> None:
        """Turn the angles to float64. Raises InputError for what is no number."""
        object.__setattr__(self, "pan_tilt_rad", float_array("start: pan_tilt_rad", self.pan_tilt_rad))


def in_turns_of_telemetry(start: Start, traverse: Traverse) -> Start:
    """The start with angles within half a turn of telemetry's, whose priors know nothing of whole turns."""
    said = traverse.pan_tilt_rad
    if start.pan_tilt_rad.shape != said.shape:
        raise InputError(
            f"start: pan_tilt_rad: expected shape {said.shape}, one row for each frame, "
            f"found {start.pan_tilt_rad.shape}"
        )
    off = start.pan_tilt_rad - said
    if np.all(np.abs(off) <= np.pi):
        return start
    near = np.where(np.abs(off) <= np.pi, start.pan_tilt_rad, said + wrap_angle(off))
    return replace(start, pan_tilt_rad=near)


def start_from_telemetry(traverse: Traverse) -> Start:
    """The stops and angles that the traverse gives: the default."""
    return Start(
        world_T_mast=tuple(s.world_T_mast for s in traverse.stops), pan_tilt_rad=traverse.pan_tilt_rad.copy()
    )


def start_from_odometry(traverse: Traverse, mast_T_next: Sequence[gtsam.Pose3]) -> Start:
    """Stops chained from the first by the motion between neighbours, `mast_T_next` (stops - 1).

    Raises InputError for a wrong number of motions.
    """
    if len(mast_T_next) != len(traverse.stops) - 1:
        raise InputError(
            f"odometry: expected {len(traverse.stops) - 1} motions for {len(traverse.stops)} stops, "
            f"found {len(mast_T_next)}"
        )
    poses = [traverse.stops[0].world_T_mast]
    for motion in mast_T_next:
        poses.append(poses[-1] * motion)
    return Start(world_T_mast=tuple(poses), pan_tilt_rad=traverse.pan_tilt_rad.copy())


def start_from_cameras(traverse: Traverse, projections: FloatArray) -> Start:
    """Masts, angles and cameras from the projection matrices (images, 3, 4) of all images.

    Each stop's centres, eye by eye and tilt by tilt, give a circle (thesis 4.6): its normal is the pan axis,
    its centre lies on it. The rig gives the height of the circle above the mast's origin; telemetry gives the
    frames that share a tilt, and the zero of pan. A stop whose centres determine no circle (fewer than three,
    collinear), or cover less than a quarter of it, gets its pose from the cameras' rotations and telemetry's
    angles, with a warning.

    Raises CameraError for a matrix that is no camera, InputError for a wrong number of matrices.
    """
    shape = np.shape(projections)
    if shape != (len(traverse.images), 3, 4):
        raise InputError(f"camera matrices: expected shape {(len(traverse.images), 3, 4)}, found {shape}")
    cameras = extract_free(projections, [f"images: {image.id}" for image in traverse.images])
    world_R_camera, centres = cameras.world_R_camera, cameras.centre_m
    masts: list[gtsam.Pose3] = []
    warnings: list[str] = []
    for s, stop in enumerate(traverse.stops):
        rows = np.flatnonzero(traverse.image_stop == s)
        if len(rows) == 0:
            masts.append(stop.world_T_mast)
            continue
        by_chain = mast_by_chain(traverse, rows, world_R_camera, centres)
        try:
            masts.append(_mast_by_circles(traverse, rows, world_R_camera, centres, by_chain))
        except GeometryError as error:
            warnings.append(f"stop {stop.id}: placed by rotations and telemetry's angles: {error}")
            masts.append(by_chain)
    angles = traverse.pan_tilt_rad.copy()
    masts_R, _ = pose_arrays(masts)
    mounts_R, _ = pose_arrays([e.head_T_camera for e in traverse.rig.eyes])
    for f in range(len(traverse.frames)):
        rows = np.flatnonzero(traverse.image_frame == f)
        if len(rows):
            first = int(rows[0])
            eye = int(traverse.image_eye[first])
            mast_R_head = masts_R[traverse.frame_stop[f]].T @ world_R_camera[first] @ mounts_R[eye].T
            pan_tilt = np.array(
                [mast_pan_rad(traverse.rig, mast_R_head[:, 1]), head_tilt_rad(traverse.rig, mast_R_head[2])]
            )
            angles[f] = angles[f] + wrap_angle(pan_tilt - angles[f])
    return Start(world_T_mast=tuple(masts), pan_tilt_rad=angles, cameras=cameras, warnings=tuple(warnings))


def mast_by_chain(
    traverse: Traverse, rows: np.ndarray, world_R_camera: FloatArray, centres: FloatArray
) -> gtsam.Pose3:
    """Mean of the mast poses that each camera gives through the rig at telemetry's angles."""
    chain_R, chain_t = traverse.rig.mast_T_camera(
        traverse.pan_tilt_rad[traverse.image_frame[rows]], traverse.image_eye[rows]
    )
    rotations = world_R_camera[rows] @ chain_R.transpose(0, 2, 1)
    translations = centres[rows] - (rotations @ chain_t[..., None])[..., 0]
    u, _, vt = np.linalg.svd(rotations.sum(axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return gtsam.Pose3(gtsam.Rot3(rotation), translations.mean(axis=0))


def _mast_by_circles(
    traverse: Traverse, rows: np.ndarray, world_R_camera: FloatArray, centres: FloatArray, near: gtsam.Pose3
) -> gtsam.Pose3:
    """Mast pose by circles: their mean normal is its z axis, on which the rig places the origin."""
    rig, up = traverse.rig, near.rotation().matrix()[:, 2]
    mounts_R, _ = pose_arrays([e.head_T_camera for e in rig.eyes])
    normals, origins, weights = [], [], []
    reasons: list[tuple[int, str]] = []
    for eye in np.unique(traverse.image_eye[rows]):
        of_eye = rows[traverse.image_eye[rows] == eye]
        for same_tilt in _same_tilt(of_eye, traverse.pan_tilt_rad[traverse.image_frame[of_eye], 1]):
            try:
                fit = fit_circle(centres[same_tilt], up)
            except GeometryError as error:
                reasons.append((len(same_tilt), str(error)))
                continue
            if fit.short_arc:
                degrees = np.rad2deg(fit.arc_rad)
                reasons.append(
                    (
                        len(same_tilt),
                        f"circle: the centres cover {degrees:.0f} degrees only; 90 or more are needed",
                    )
                )
                continue
            z = fit.rotation[:, 2]
            tilts = [head_tilt_rad(rig, mounts_R[eye] @ world_R_camera[i].T @ z) for i in same_tilt]
            _, _, height = rig.circle(int(eye), float(np.mean(tilts)))
            normals.append(z)
            origins.append(fit.centre_m - height * z)
            weights.append(len(same_tilt))
    if not normals:
        raise GeometryError(max(reasons, key=lambda reason: reason[0])[1])
    z = np.average(normals, axis=0, weights=weights)
    z /= np.linalg.norm(z)
    x = near.rotation().matrix()[:, 0]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    rotation = np.column_stack([x, np.cross(z, x), z])
    return gtsam.Pose3(gtsam.Rot3(rotation), np.average(origins, axis=0, weights=weights))


def _same_tilt(rows: IntArray, tilt_rad: FloatArray) -> list[IntArray]:
    """Rows (n,) in groups whose tilts (n,) differ by less than `_ONE_TILT_RAD`, each in the order given."""
    group = np.empty(len(rows), dtype=np.int64)
    first = -np.inf
    number = -1
    for i in np.argsort(tilt_rad, kind="stable"):
        if tilt_rad[i] - first > _ONE_TILT_RAD:
            first, number = tilt_rad[i], number + 1
        group[i] = number
    return [rows[group == g] for g in range(number + 1)]
