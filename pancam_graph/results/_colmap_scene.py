"""A solution as COLMAP's rigs, frames, cameras and points: pinholes, observations moved to them."""

from dataclasses import dataclass, field

import numpy as np

from pancam_graph.base.errors import CameraError, InputError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray, compose, corrected_poses, pose_arrays
from pancam_graph.cameras import Camera, Pinhole, straight_pixels, straightened
from pancam_graph.data import Solution

__all__ = ["Placed", "RigGroup", "Straight", "place_observations", "rigs_and_heads", "straight_cameras"]

_FAR_M = 1e4
"""Range at which images without observations are resampled: the pupil then shifts less than 0.001 px."""
_SAME_TURN, _SAME_SHIFT = 1e-9, 1e-9
_MIN_DEPTH = 1e-6
_DIFFERENCE_PX, _DIFFERENCE_SHARE = 1e-3, 0.02
"""Largest difference of a residual from the solution's: pixels, for rounding, and a share of it, for the
curvature of distortion."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Straight:
    """A camera and the pinhole that its images are resampled to."""

    camera: Camera
    pinhole: Pinhole
    range_m: float
    """Range at which the images are resampled; it matters only where the entrance pupil moves."""


@dataclass(kw_only=True, eq=False)
class RigGroup:
    """Cameras whose poses relative to each other are the same in some frames."""

    cameras: dict[int, Camera] = field(default_factory=dict)
    """Camera of each eye, by the number of the eye in the rig."""
    head_T_camera: dict[int, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    """Mount of each eye, by the same number: rotation (3, 3) and translation (3,)."""
    own: bool = False
    """Whether it serves one frame alone, whose eyes are not where the rig's mounts put them."""

    def takes(self, eye: int, camera: Camera, rotation: FloatArray, translation: FloatArray) -> bool:
        """Whether an eye can join: it is not in the group yet, or is there with the same camera and mount."""
        if eye not in self.cameras:
            return True
        R, t = self.head_T_camera[eye]
        return self.cameras[eye] is camera and np.array_equal(R, rotation) and np.array_equal(t, translation)


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """Used observations on the straightened images, in the order of image, then of the input's rows."""

    row: IntArray
    """(m,) row in the traverse's observations."""
    image: IntArray
    """(m,) row of the image."""
    landmark: IntArray
    """(m,) row of the landmark."""
    uv_px: FloatArray
    """(m, 2) pixel on the straightened image, carried there at its landmark's range."""
    residual_px: FloatArray
    """(m, 2) where the straightened pinhole sees the landmark, less `uv_px`."""
    enlargement: FloatArray
    """(m, 2, 2) takes small residuals of the image as taken to residuals of the straightened one."""
    shift_px: FloatArray
    """(m,) shift of the pixel by resampling at another range than its landmark's; 0 unless the pupil
    moves."""
    beyond: int
    """How many landmarks were left out because they fit best beyond infinity."""


def finite_images(solution: Solution) -> BoolArray:
    """(images,) whether each image has a finite pose."""
    R, t = solution.final.world_R_camera, solution.final.world_t_camera
    return np.asarray(np.isfinite(R).all(axis=(1, 2)) & np.isfinite(t).all(axis=1))


def straight_cameras(solution: Solution) -> list[Straight | None]:
    """The straightened camera of each image, one object for all of a camera; None without a finite pose.

    Raises InputError for a camera of which a pinhole shows nothing.
    """
    range_m, image = _ranges(solution)
    cameras, finite = solution.image_cameras, finite_images(solution)
    number: dict[int, int] = {}
    of_image = np.array([number.setdefault(id(c), len(number)) for c in cameras])
    made: dict[int, Straight] = {}
    for i in np.flatnonzero(finite).tolist():
        if of_image[i] in made:
            continue
        seen = range_m[of_image[image] == of_image[i]]
        typical_m = float(np.median(seen)) if len(seen) else _FAR_M
        try:
            pinhole = straightened(cameras[i], typical_m)
        except CameraError as error:
            raise InputError(f"colmap: camera {solution.traverse.images[i].camera}: {error}") from error
        made[of_image[i]] = Straight(camera=cameras[i], pinhole=pinhole, range_m=typical_m)
    return [made[of_image[i]] if finite[i] else None for i in range(len(cameras))]


def _ranges(solution: Solution) -> tuple[FloatArray, IntArray]:
    """Range of the landmark, metres, and image of each used observation that has one."""
    row, image = _usable(solution)
    away = solution.final.landmarks_m[solution.landmark_row[row]] - solution.final.world_t_camera[image]
    return np.linalg.norm(away, axis=1), image


def _usable(solution: Solution) -> tuple[IntArray, IntArray]:
    """Rows of the used observations that have a landmark and a finite camera, by image; and their images."""
    observations, landmark = solution.traverse.observations, solution.landmark_row
    if observations is None:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    placed = np.append(np.isfinite(solution.final.landmarks_m).all(axis=1), False)  # row -1: none
    use = solution.used & placed[landmark] & finite_images(solution)[observations.image]
    row = np.flatnonzero(use)
    row = row[np.argsort(observations.image[row], kind="stable")]
    return row, observations.image[row]


def place_observations(solution: Solution, straight: list[Straight | None]) -> Placed:
    """The used observations on the straightened images.

    Left out are those outside a model's domain, of landmarks that are not in front of their camera, of
    landmarks that fit best beyond infinity (the solution has their least range, at which residuals are
    others), and of landmarks that then have fewer than two images.
    """
    row, image = _usable(solution)
    range_m, _ = _ranges(solution)
    landmark = solution.landmark_row[row]
    final, observations = solution.final, solution.traverse.observations
    n = len(row)
    uv, residual, shift = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n)
    enlargement, valid = np.zeros((n, 2, 2)), np.zeros(n, dtype=bool)
    limits = np.searchsorted(image, np.arange(len(straight) + 1))
    for i, s in enumerate(straight):
        rows = slice(limits[i], limits[i + 1])
        if s is None or observations is None or limits[i] == limits[i + 1]:
            continue
        raw = observations.uv_px[row[rows]]
        uv[rows], enlargement[rows], valid[rows] = straight_pixels(s.camera, s.pinhole, raw, range_m[rows])
        if s.camera.pupil_moves:
            level = np.full(len(raw), s.range_m)
            shift[rows] = np.linalg.norm(
                uv[rows] - straight_pixels(s.camera, s.pinhole, raw, level)[0], axis=1
            )
        points = (final.landmarks_m[landmark[rows]] - final.world_t_camera[i]) @ final.world_R_camera[i]
        projected, in_front = s.pinhole.project(points)
        residual[rows] = projected - uv[rows]
        valid[rows] &= in_front & (points[:, 2] > _MIN_DEPTH)
    expected_px = np.einsum("nij,nj->ni", enlargement, solution.residual_final_px[row])
    bound = _DIFFERENCE_PX + _DIFFERENCE_SHARE * np.linalg.norm(expected_px, axis=1)
    other = valid & (np.linalg.norm(residual - expected_px, axis=1) > bound)
    beyond = np.unique(landmark[other])
    valid &= ~np.isin(landmark, beyond)
    views = np.bincount(landmark[valid], minlength=len(solution.landmark_track))
    keep = valid & (views[landmark] > 1)
    return Placed(
        row=row[keep],
        image=image[keep],
        landmark=landmark[keep],
        uv_px=uv[keep],
        residual_px=residual[keep],
        enlargement=enlargement[keep],
        shift_px=shift[keep],
        beyond=len(beyond),
    )


def rigs_and_heads(
    solution: Solution,
) -> tuple[list[RigGroup], dict[int, tuple[int, FloatArray, FloatArray]]]:
    """Rigs, and of each frame its rig's index and `world_T_head`: rotation (3, 3), translation (3,).

    Frames whose eyes are where the mounts put them share a rig if their cameras and mounts are the
    same: all frames of the model `mast`, unless stops or images have mounts or calibrations of their own.
    A frame whose eyes moved on their own (models `circle`, `free`, `projective`) gets a rig of its own.
    Frames without an image that has a finite pose are left out.
    """
    traverse, final = solution.traverse, solution.final
    nominal_R, nominal_t = pose_arrays([e.head_T_camera for e in traverse.rig.eyes])
    mount_R, mount_t = nominal_R[traverse.image_eye], nominal_t[traverse.image_eye]
    if final.rig is not None:
        mount_R, mount_t = corrected_poses(mount_R, mount_t, final.rig.mount)
    back_R = mount_R.transpose(0, 2, 1)
    back_t = -np.einsum("nij,nj->ni", back_R, mount_t)
    head_R, head_t = compose(final.world_R_camera, final.world_t_camera, back_R, back_t)
    finite = finite_images(solution)
    rigs: list[RigGroup] = []
    heads: dict[int, tuple[int, FloatArray, FloatArray]] = {}
    by_frame = np.argsort(traverse.image_frame, kind="stable")
    limits = np.searchsorted(traverse.image_frame[by_frame], np.arange(len(traverse.frames) + 1))
    for f in range(len(traverse.frames)):
        images = by_frame[limits[f] : limits[f + 1]]
        images = images[finite[images]]
        if len(images) == 0:
            continue
        images = images[np.argsort(traverse.image_eye[images])]
        R, t = head_R[images[0]], head_t[images[0]]
        turn = np.abs(head_R[images] - R).max()
        shift = np.abs(head_t[images] - t).max()
        rigid = bool(turn < _SAME_TURN and shift < _SAME_SHIFT * max(1.0, float(np.abs(t).max())))
        mounts = {int(traverse.image_eye[i]): (mount_R[i], mount_t[i]) for i in images}
        if not rigid:
            seen = compose(R.T, -R.T @ t, final.world_R_camera[images], final.world_t_camera[images])
            mounts = dict(zip(mounts, zip(*seen, strict=True), strict=True))
        cameras = {int(traverse.image_eye[i]): solution.image_cameras[i] for i in images}
        fitting = (
            r
            for r, rig in enumerate(rigs)
            if rigid and not rig.own and all(rig.takes(e, cameras[e], *mounts[e]) for e in cameras)
        )
        number = next(fitting, len(rigs))
        if number == len(rigs):
            rigs.append(RigGroup(own=not rigid))
        rigs[number].cameras.update(cameras)
        rigs[number].head_T_camera.update(mounts)
        heads[f] = number, R, t
    return rigs, heads
