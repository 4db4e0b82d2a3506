"""What terrain is made from: a traverse with refined and with telemetry's cameras."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import Camera
from pancam_graph.data import Solution, StereoCovariance, Traverse, stereo_order
from pancam_graph.io import picture_file, same_pictures

__all__ = ["Drive", "Pair", "drive_of", "stereo_pairs"]


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
    stereo: StereoCovariance | None = None
    """Errors that places of a frame have in common; None: unknown."""

    @cached_property
    def own_tilt_sigma_rad(self) -> FloatArray:
        """(frames,) standard deviation of that part of a tilt's error which is the frame's alone.

        Where errors in common are known, these have what the surest frame of a stop is uncertain of. A tilt
        of which nothing is known counts as exact.
        """
        variance = np.nan_to_num(self.angle_sigma_rad[:, 1]) ** 2
        if self.stereo is not None:
            stop = self.traverse.frame_stop
            least = np.full(len(self.traverse.stops), np.inf)
            np.minimum.at(least, stop, variance)
            variance = variance - least[stop]
        return np.asarray(np.sqrt(variance))

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
        stereo=solution.stereo_covariance,
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
    both, focal = [a, b], [drive.cameras[i].pinhole.fx_px for i in (a, b)]
    order = stereo_order((focal[0], focal[1]), drive.world_R_camera[both], drive.world_t_camera[both])
    if order is None:
        return None
    between = drive.world_t_camera[b] - drive.world_t_camera[a]
    baseline_m = float(np.linalg.norm(between))
    return Pair(frame=frame, left=both[order[0]], right=both[order[1]], baseline_m=baseline_m)
