"""The text file that the Ceres program reads: the same problem, landmarks started near the truth."""

from pathlib import Path

import gtsam
import numpy as np

from pancam_graph import Traverse
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import HEAD_R_FORWARD_CAMERA, FloatArray, rz, wxyz_from_rotation
from pancam_graph.cameras import Pinhole
from pancam_graph.rigs import Rig

__all__ = ["write_peer"]

_SAME = 1e-12


def write_peer(traverse: Traverse, start_m: FloatArray, path: Path) -> None:
    """Write a traverse with observations; landmarks (tracks, 3) in metres start at `start_m`, row = track.

    The peer knows one kind of mast: pan and tilt axes that meet, two equal pinholes beside each other that
    may toe in, one sigma for all pixels, one for all angles, two for all stops but the first, which is held.
    Raises InputError naming what it cannot express.
    """
    observations = traverse.observations
    if observations is None:
        raise InputError("observations: expected some for the peer, found none")
    focal_px, centre_px, baseline_m, toe_in_rad, forward_m = _mast(traverse.rig)
    angles = [(f.sigma_pan_rad, f.sigma_tilt_rad) for f in traverse.frames]
    stops = [(s.sigma_rotation_rad, s.sigma_translation_m) for s in traverse.stops]
    if stops[0] != (0.0, 0.0):
        raise InputError(
            f"stops: {traverse.stops[0].id}: expected to be held (sigmas of 0), found {stops[0]}"
        )
    if observations.covariance_px2 is not None:
        raise InputError("observations: covariance_px2: the peer expects none, only sigma_px; found some")
    sigma_px = _one("observations: sigma_px", observations.sigma_px)
    sigma_angle_rad = _one("frames: sigmas of pan and tilt", np.array(angles))
    sigma_rotation_rad, sigma_translation_m = (
        _one("stops: sigmas", np.array(column[1:])) if len(stops) > 1 else 1.0
        for column in zip(*stops, strict=True)
    )
    counts = (len(traverse.stops), len(traverse.frames), len(start_m), len(observations))
    header = (
        *counts, focal_px, centre_px, baseline_m, toe_in_rad, forward_m,
        sigma_px, sigma_angle_rad, sigma_rotation_rad, sigma_translation_m,
    )  # fmt: skip
    of_frame = np.column_stack([traverse.frame_stop, traverse.pan_tilt_rad])
    seen = np.column_stack(
        [
            traverse.image_frame[observations.image],
            traverse.image_eye[observations.image],
            observations.track,
            observations.uv_px,
        ]
    )
    exact, whole = "%.17g", "%d"
    with path.open("w", encoding="ascii") as out:
        out.write(" ".join(f"{x!r}" for x in header) + "\n")
        np.savetxt(out, [_pose_row(s.world_T_mast) for s in traverse.stops], fmt=exact)
        np.savetxt(out, of_frame, fmt=[whole, exact, exact])
        np.savetxt(out, start_m, fmt=exact)
        np.savetxt(out, seen, fmt=[whole, whole, whole, exact, exact])


def _mast(rig: Rig) -> tuple[float, float, float, float, float]:
    """Focal length and centre in pixels, baseline in metres, toe-in in radians, forward offset in metres."""
    fault = f"rig {rig.name}: the peer expects"
    if len(rig.eyes) != 2:
        raise InputError(f"{fault} two cameras, found {len(rig.eyes)}")
    if not rig.pan_T_tilt.equals(gtsam.Pose3(), _SAME):
        raise InputError(f"{fault} pan and tilt axes that meet, found {rig.pan_T_tilt}")
    left, right = rig.eyes
    for eye in rig.eyes:
        c = eye.camera
        plain = isinstance(c, Pinhole) and c == c.pinhole and (c.fx_px, c.cx_px) == (c.fy_px, c.cy_px)
        if not plain or c.pinhole.skew_px != 0:
            raise InputError(f"{fault} a pinhole with one focal length and one centre, found {c}")
    if left.camera.pinhole != right.camera.pinhole:
        raise InputError(f"{fault} two equal cameras, found {left.camera} and {right.camera}")
    forward_m, half_m, _ = left.head_T_camera.translation()
    axis = left.head_T_camera.rotation().matrix()[:, 2]
    half_rad = -np.arctan2(axis[1], axis[0])
    for eye, side in ((left, 1), (right, -1)):
        rotation = gtsam.Rot3(rz(-side * half_rad) @ HEAD_R_FORWARD_CAMERA)
        expected = gtsam.Pose3(rotation, np.array([forward_m, side * half_m, 0.0]))
        if not eye.head_T_camera.equals(expected, _SAME):
            raise InputError(
                f"{fault} cameras that mirror each other, found {eye.name} at {eye.head_T_camera}"
            )
    pinhole = left.camera.pinhole
    return pinhole.fx_px, pinhole.cx_px, float(2 * half_m), float(2 * half_rad), float(forward_m)


def _one(what: str, values: FloatArray) -> float:
    """The number that all are."""
    low, high = float(np.min(values)), float(np.max(values))
    if high - low > _SAME * high:
        raise InputError(f"{what}: the peer expects one number for all, found {low} to {high}")
    return low


def _pose_row(pose: gtsam.Pose3) -> FloatArray:
    """w, x, y, z of the rotation, then the translation in metres."""
    return np.concatenate([wxyz_from_rotation(pose.rotation().matrix()), pose.translation()])
