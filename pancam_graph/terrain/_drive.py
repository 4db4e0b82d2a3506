"""What terrain is made from: a traverse with refined and with telemetry's cameras."""

from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Camera
from pancam_graph.data import Solution, Traverse
from pancam_graph.io import picture_file, same_pictures

__all__ = ["Drive", "Pair", "drive_of", "stereo_pairs"]

_ALIKE_FOCAL = 1.5
"""Factor by which focal lengths of a pair of eyes may differ."""
_LEAST_BASELINE_M = 1e-3
_ALIKE_AXES = np.cos(np.deg2rad(30.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """A traverse with the cameras that terrain is drawn with."""

    traverse: Traverse
    cameras: tuple[Camera, ...]
    """Adjusted camera of each image."""
    world_R_camera: FloatArray
    """(images, 3, 3) as adjusted; NaN where unknown."""
    world_t_camera: FloatArray
    """(images, 3) as adjusted, metres."""
    angle_sigma_rad: FloatArray
    """(frames, 2) standard deviation of pan and tilt; NaN where unknown."""

    def telemetry(self) -> tuple[FloatArray, FloatArray]:
        """Orientations (images, 3, 3) and centres (images, 3) of cameras by telemetry."""
        return self.traverse.camera_poses()


def drive_of(solution: Solution) -> Drive:
    """The drive of a solution that is in memory."""
    return Drive(
        traverse=solution.traverse,
        cameras=solution.image_cameras,
        world_R_camera=solution.final.world_R_camera,
        world_t_camera=solution.final.world_t_camera,
        angle_sigma_rad=solution.angle_sigma_rad,
    )


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two pictures of one frame that see in stereo."""

    frame: int
    left: int
    """Row of the image from whose side the other eye lies towards the right of its picture."""
    right: int
    baseline_m: float


def stereo_pairs(drive: Drive) -> tuple[list[Pair], list[str]]:
    """The stereo pair of each frame that has one, and a warning of each that does not.

    Of more than two eyes those of the longest baseline are taken whose focal lengths are alike, which look
    the same way, and which both have a picture.
    """
    traverse = drive.traverse
    twice = same_pictures(traverse)
    there = np.array(
        [picture_file(traverse, i) is not None and i not in twice for i in range(len(traverse.images))]
    )
    there &= np.isfinite(drive.world_R_camera).all(axis=(1, 2)) & np.isfinite(drive.world_t_camera).all(
        axis=1
    )
    pairs, lacking = list[Pair](), list[str]()
    for frame, entry in enumerate(traverse.frames):
        rows = np.flatnonzero((traverse.image_frame == frame) & there).tolist()
        found = [p for i, a in enumerate(rows) for b in rows[i + 1 :] if (p := _pair(drive, frame, a, b))]
        if found:
            pairs.append(max(found, key=lambda p: p.baseline_m))
        else:
            lacking.append(entry.id)
    warnings = []
    if pairs and lacking:
        named = ", ".join(lacking[:5]) + (f" and {len(lacking) - 5} more" if len(lacking) > 5 else "")
        warnings.append(f"terrain: frames without a stereo pair of pictures are left out: {named}")
    return pairs, warnings


def _pair(drive: Drive, frame: int, a: int, b: int) -> Pair | None:
    focal = [drive.cameras[i].pinhole.fx_px for i in (a, b)]
    R = drive.world_R_camera
    between = drive.world_t_camera[b] - drive.world_t_camera[a]
    baseline_m = float(np.linalg.norm(between))
    alike = max(focal) < _ALIKE_FOCAL * min(focal) and R[a][:, 2] @ R[b][:, 2] > _ALIKE_AXES
    if not alike or baseline_m < _LEAST_BASELINE_M:
        return None
    # The first axis that the baseline has a larger part of decides; an eye above the other is turned.
    to_right, down = between @ R[a][:, 0], between @ R[a][:, 1]
    first = to_right if abs(to_right) >= abs(down) else down
    pair = Pair(frame=frame, left=int(a), right=int(b), baseline_m=baseline_m)
    return pair if first > 0 else replace(pair, left=int(b), right=int(a))
