"""What VICAR's files say of a solution: sites with z down, pairs of pictures, cameras of the CAHV family."""

from collections.abc import Iterator

import gtsam
import numpy as np

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import Z_DOWN_R_Z_UP, FloatArray, IntArray
from pancam_graph.cameras import CAHV, Camera, as_cahv, without_field
from pancam_graph.io.vicar import ReferenceFrame
from pancam_graph.results.formats._source import Source
from pancam_graph.rigs import camera_z_up

__all__ = ["as_model", "nearest_points", "pairs_of_tracks", "site_frame", "site_xyz", "told_and_found"]


def site_frame(source: Source, name: str = "SITE_FRAME") -> ReferenceFrame:
    """The frame of the world, z down, by the site of the first stop."""
    first = int(np.flatnonzero(source.solution.traverse.image_stop == 0)[0]) if source.identities else 0
    return ReferenceFrame(name=name, index=(source.identities[first].place[0],))


def site_xyz(points_m: FloatArray) -> FloatArray:
    """Points or directions (..., 3) of the world in the site frame, z down, and back."""
    return np.asarray(points_m @ Z_DOWN_R_Z_UP)


def as_model(camera: Camera) -> CAHV | None:
    """A camera as a model of the CAHV family, without its smooth field; None where there is no equal."""
    try:
        return as_cahv(without_field(camera))
    except CameraError:
        return None


def told_and_found(source: Source, image: int) -> tuple[CAHV, CAHV] | None:
    """An image's camera before and after, in the rover frame, z down; in the site frame without a rover.

    None for a lens without an equal in the CAHV family, and without a finite pose.
    """
    solution = source.solution
    traverse = solution.traverse
    stop = int(traverse.image_stop[image])
    out = []
    for camera, state, rig in (
        (traverse.rig.eyes[int(traverse.image_eye[image])].camera, solution.initial, traverse.rig),
        (solution.image_cameras[image], solution.final, solution.rig),
    ):
        model = as_model(camera)
        R, t = state.world_R_camera[image], state.world_t_camera[image]
        if model is None or not (np.isfinite(R).all() and np.isfinite(t).all()):
            return None
        pose = gtsam.Pose3(gtsam.Rot3(R), t)
        if rig.rover_T_mast is not None:
            pose = rig.rover_T_mast * state.world_T_mast[stop].inverse() * pose
        out.append(camera_z_up(model.transformed(pose)))  # the turn to z up is that to z down
    return out[0], out[1]


def pairs_of_tracks(source: Source) -> Iterator[tuple[int, IntArray]]:
    """Track, and rows of its observations in use on images with a pose, of each track that two images see."""
    solution = source.solution
    observations = solution.traverse.observations
    if observations is None:
        return
    placed = np.zeros(len(solution.traverse.images), dtype=bool)
    placed[source.placed()] = True
    rows = np.flatnonzero(solution.used & placed[observations.image])
    rows = rows[np.lexsort((observations.image[rows], observations.track[rows]))]
    track = observations.track[rows]
    for part in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(track)) + 1):
        if len(part) > 1:
            yield int(track[part[0]]), rows[part]


def nearest_points(
    origin_a: FloatArray, ray_a: FloatArray, origin_b: FloatArray, ray_b: FloatArray
) -> tuple[FloatArray, float]:
    """The middle (3,) between two lines of sight where they are nearest, and their distance there.

    Of parallel ones the middle is between their origins.
    """
    across = np.cross(ray_a, ray_b)
    square = float(across @ across)
    apart = origin_b - origin_a
    if square < 1e-24:
        return (origin_a + origin_b) / 2, float(np.linalg.norm(np.cross(apart, ray_a)))
    on_a = origin_a + (np.cross(apart, ray_b) @ across) / square * ray_a
    on_b = origin_b + (np.cross(apart, ray_a) @ across) / square * ray_b
    return (on_a + on_b) / 2, float(np.linalg.norm(on_b - on_a))
