"""Seen direction factor: what a camera sees at a known pixel lies in a known direction (2 rows).

    e = rotation vector that turns the pixel's line of sight q to the direction p = world_R_camera' d

The residual is e along two axes across the line of sight of the rig's own camera, radians. It is an angle,
not a pixel, so that it has a slope wherever the camera looks but in the very opposite direction. What is seen
has no parallax: where the camera is does not count.
"""

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, axes_across, skew
from pancam_graph.cameras import CALIBRATION_ENTRIES, Camera
from pancam_graph.factors._slots import Kind, PoseSlot, Slot, custom_factor
from pancam_graph.factors.mast import Pose, mast_chain

__all__ = [
    "SeenPixel",
    "camera_direction_factor",
    "mast_direction_factor",
    "seen_direction_residual",
]

_SMALL = 1e-4
"""Sine below which quotients of angle and sine are series, whose next term is below rounding."""
_OPPOSITE = 1e-9
"""Sine below which an angle of half a turn has no axis: its Jacobians are 0."""


class SeenPixel:
    """A pixel (2,) of a camera: its line of sight for any calibration and smooth field near the rig's."""

    def __init__(
        self,
        lens: Camera,
        calibration: FloatArray,
        plain_px: FloatArray,
        *,
        basis: FloatArray | None = None,
        field: FloatArray | None = None,
    ) -> None:
        """`lens` has a K of 1 (`Camera.with_unit_calibration`) and no field, `calibration` is K (3, 3).

        `plain_px` (2,) is the pixel less the rig's field there. `basis` (5, k) takes the free entries of a
        correction of K to changes of fx, fy, skew, cx, cy; `field` (2, n) takes what the coefficients of the
        field have more than the rig's to pixels. None: these are fixed.
        """
        self._lens, self._K, self._plain_px = lens, calibration, plain_px
        self._basis = np.zeros((5, 0)) if basis is None else basis
        self._field = np.zeros((2, 0)) if field is None else field
        direction, by_px, _, self.is_valid = self._sight(calibration, plain_px)
        self.across = axes_across(direction[None])[0]
        """(2, 3) the axes of residuals, in the camera's frame."""
        turned = self.across @ skew(direction) @ by_px
        self.covariance_per_px2 = turned @ turned.T
        """(2, 2) covariance of the residual, rad^2, of a pixel whose coordinates have a sigma of 1 px."""

    def sight(self, entries: FloatArray, field_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Line of sight (3,), a unit vector; its derivatives by the entries (3, k) and the field (3, n)."""
        K = self._K.copy()
        K[CALIBRATION_ENTRIES] += self._basis @ entries
        direction, by_px, by_K, _ = self._sight(K, self._plain_px - self._field @ field_px)
        return direction, by_K @ self._basis, -by_px @ self._field

    def _sight(self, K: FloatArray, plain_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
        """Direction (3,), its derivatives by the pixel (3, 2) and by K (3, 5), and whether it is valid."""
        back = np.linalg.inv(K[:2, :2])
        xy = back @ (plain_px - K[:2, 2])
        rays, _, d_direction = self._lens.unproject_with_jacobian(xy[None])
        by_px = d_direction[0] @ back
        moved = np.zeros((2, 5))
        for column, (row, entry) in enumerate(zip(*CALIBRATION_ENTRIES, strict=True)):
            moved[row, column] = 1.0 if entry == 2 else xy[entry]
        return rays.direction[0], by_px, -by_px @ moved, bool(rays.valid[0])


def seen_direction_residual(
    world_R_camera: FloatArray, direction: FloatArray, sight: FloatArray, across: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residual (2,), radians, and Jacobians by the camera's turn (2, 3), body frame, and by the sight (2, 3).

    `direction` (3,) of the world and `sight` (3,) of the camera are unit vectors; `across` (2, 3) are axes of
    the camera. Where they point in opposite directions to 1e-9, the Jacobians are 0.
    """
    p, q = world_R_camera.T @ direction, sight
    axis, cosine = np.cross(q, p), float(q @ p)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, cosine)
    if sine > _SMALL:
        factor, slope = angle / sine, (angle * cosine - sine) / sine**3
    elif cosine > 0:
        factor, slope = 1 + sine**2 / 6, -1 / 3
    elif sine > _OPPOSITE:
        factor, slope = angle / sine, angle * cosine / sine**3
    else:
        return np.array([np.pi, 0.0]), np.zeros((2, 3)), np.zeros((2, 3))
    by_p = factor * skew(q) + slope * np.outer(axis, q)
    by_q = -factor * skew(p) + slope * np.outer(axis, p)
    # A turn of the camera moves what it sees the other way.
    return factor * (across @ axis), across @ by_p @ skew(p), across @ by_q


def mast_direction_factor(
    noise: gtsam.noiseModel.Base,
    pixel: SeenPixel,
    world_T_mast: Slot,
    pan_tilt_rad: Slot,
    head_T_camera: PoseSlot,
    pan_T_tilt: PoseSlot,
    calibration: Slot,
    field: Slot,
    tilted_T_head: PoseSlot | None = None,
    *,
    direction: FloatArray,
) -> gtsam.CustomFactor:
    """The factor of `seen_direction_residual` for a camera on the rigid mast (`mast_chain`).

    The slots `calibration` and `field` have the vectors that `SeenPixel.sight` takes, of no entries where
    these are fixed. Without `tilted_T_head` that is the identity.
    """

    def residual(
        mast: Pose,
        pan_tilt: FloatArray,
        mount: Pose,
        axis: Pose,
        entries: FloatArray,
        field_px: FloatArray,
        head: Pose | None = None,
    ) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        (rotation, _), twists = mast_chain(mast, pan_tilt, mount, axis, head)
        error, by_turn, by_entries, by_field = _seen(pixel, rotation, direction, entries, field_px)
        by_mast, by_pan, by_down, by_axis, by_head = (by_turn @ twist[:, :3] for twist in twists)
        by_mount = np.concatenate([by_turn, np.zeros((1, 2, 3))], axis=2)
        by_angles = np.concatenate([by_pan, -by_down], axis=2)
        rigid = by_mast, by_angles, by_mount, by_axis, by_entries, by_field
        return error, rigid if head is None else (*rigid, by_head)

    slots: list[tuple[PoseSlot, Kind]] = [
        (world_T_mast, "pose"),
        (pan_tilt_rad, "vector"),
        (head_T_camera, "pose"),
        (pan_T_tilt, "pose"),
        (calibration, "vector"),
        (field, "vector"),
    ]
    if tilted_T_head is not None:
        slots.append((tilted_T_head, "pose"))
    return custom_factor(noise, slots, residual)


def camera_direction_factor(
    noise: gtsam.noiseModel.Base,
    pixel: SeenPixel,
    world_T_camera: Slot,
    calibration: Slot,
    *,
    direction: FloatArray,
) -> gtsam.CustomFactor:
    """The factor of `seen_direction_residual` for a camera whose pose is a variable; no field is free."""

    def residual(camera: Pose, entries: FloatArray) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        error, by_turn, by_entries, _ = _seen(pixel, camera[0], direction, entries, np.zeros((1, 0)))
        return error, (np.concatenate([by_turn, np.zeros((1, 2, 3))], axis=2), by_entries)

    return custom_factor(noise, [(world_T_camera, "pose"), (calibration, "vector")], residual)


def _seen(
    pixel: SeenPixel, rotation: FloatArray, direction: FloatArray, entries: FloatArray, field_px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residual (1, 2), and Jacobians (1, 2, k) by the camera's turn, by entries of K, and by the field."""
    sight, by_entries, by_field = pixel.sight(entries[0], field_px[0])
    error, by_turn, by_sight = seen_direction_residual(rotation[0], direction, sight, pixel.across)
    return error[None], by_turn[None], (by_sight @ by_entries)[None], (by_sight @ by_field)[None]
