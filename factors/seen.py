"""Seen factor: what a camera sees at a known pixel lies in a known direction, or place (2 rows).

    e = rotation vector that turns the pixel's line of sight q to the direction p

The residual is e along two axes across the line of sight of the rig's own camera, radians. It is an angle,
not a pixel, so that it has a slope wherever the camera looks but in the very opposite direction.

Of a direction d of the world p = world_R_camera' d: where the camera is does not count. Of a place x of the
world p is the direction from where the line of sight starts to x, at a range r, and the residual is whitened:
its covariance is that of the pixel and that of the place over r^2, along axes where both are diagonal.
"""

from abc import ABC, abstractmethod

import gtsam
import numpy as np

from pancam_graph.base.geometry import FloatArray, axes_across, skew
from pancam_graph.cameras import CALIBRATION_ENTRIES, Camera
from pancam_graph.factors._slots import Kind, PoseSlot, Slot, custom_factor
from pancam_graph.factors.mast import Pose, mast_chain

__all__ = ["Seen", "SeenDirection", "SeenPixel", "SeenPlace", "camera_seen_factor", "mast_seen_factor"]

_SMALL = 1e-4
"""Sine below which quotients of angle and sine are series, whose next term is below rounding."""
_NEAREST_M = 1e-6
"""Range below which a place has no direction."""
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
        sight, by_px, _, self.is_valid = self._sight(calibration, plain_px)
        direction = sight[3:]
        across = axes_across(direction[None])[0]
        turned = across @ skew(direction) @ by_px[3:]
        self.variance_per_px2, axes = np.linalg.eigh(turned @ turned.T)
        """(2,) variances of the residual, rad^2, of a pixel whose coordinates have a sigma of 1 px."""
        self.across = axes.T @ across
        """(2, 3) the axes of residuals, in the camera's frame: those of the pixel's covariance."""

    def sight(self, entries: FloatArray, field_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Where the line of sight starts, metres, and its unit vector (6,); derivatives.

        They are by the entries (6, k) and by the field (6, n).
        """
        K = self._K.copy()
        K[CALIBRATION_ENTRIES] += self._basis @ entries
        sight, by_px, by_K, _ = self._sight(K, self._plain_px - self._field @ field_px)
        return sight, by_K @ self._basis, -by_px @ self._field

    def _sight(self, K: FloatArray, plain_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
        """Sight (6,), its derivatives by the pixel (6, 2) and by K (6, 5), and whether it is valid."""
        back = np.linalg.inv(K[:2, :2])
        xy = back @ (plain_px - K[:2, 2])
        rays, d_origin, d_direction = self._lens.unproject_with_jacobian(xy[None])
        by_px = np.concatenate([d_origin[0], d_direction[0]]) @ back
        moved = np.zeros((2, 5))
        for column, (row, entry) in enumerate(zip(*CALIBRATION_ENTRIES, strict=True)):
            moved[row, column] = 1.0 if entry == 2 else xy[entry]
        sight = np.concatenate([rays.origin_m[0], rays.direction[0]])
        return sight, by_px, -by_px @ moved, bool(rays.valid[0])


def _turn(p: FloatArray, q: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation vector from q to p along `across` (2, 3), radians, and its Jacobians (2, 3) by p and q.

    Both are unit vectors (3,). Where they are opposite to 1e-9, it is half a turn and the Jacobians are 0.
    """
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
    return factor * (across @ axis), across @ by_p, across @ by_q


class Seen(ABC):
    """What a pixel sees."""

    def __init__(self, pixel: SeenPixel) -> None:
        self.pixel = pixel

    @property
    @abstractmethod
    def noise(self) -> gtsam.noiseModel.Base:
        """The noise of the residual."""

    @abstractmethod
    def residual(self, camera: Pose, sight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residual (2,), and Jacobians by the camera's body-frame tangent (2, 6) and by the sight (2, 6).

        `camera` is world_R_camera (3, 3) and world_t_camera (3,), metres; `sight` as of `SeenPixel.sight`.
        """


class SeenDirection(Seen):
    """A direction (3,) of the world, a unit vector, known to `sigma_rad` across it, at a pixel."""

    def __init__(
        self, pixel: SeenPixel, direction: FloatArray, *, sigma_px: float, sigma_rad: float = 0.0
    ) -> None:
        super().__init__(pixel)
        self._direction = direction
        self._sigmas = np.sqrt(sigma_px**2 * pixel.variance_per_px2 + sigma_rad**2)

    @property
    def noise(self) -> gtsam.noiseModel.Base:
        """Of radians."""
        return gtsam.noiseModel.Diagonal.Sigmas(self._sigmas)

    def residual(self, camera: Pose, sight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As in the base class, radians."""
        p = camera[0].T @ self._direction
        error, by_p, by_q = _turn(p, sight[3:], self.pixel.across)
        none = np.zeros((2, 3))
        # A turn of the camera moves what it sees the other way.
        return error, np.hstack([by_p @ skew(p), none]), np.hstack([none, by_q])


class SeenPlace(Seen):
    """A place (3,) of the world, metres, known to `sigma_m` along each axis, at a pixel."""

    def __init__(self, pixel: SeenPixel, place_m: FloatArray, *, sigma_px: float, sigma_m: float) -> None:
        super().__init__(pixel)
        self._place_m, self._variance_m2 = place_m, sigma_m**2
        self._variance_rad2 = sigma_px**2 * pixel.variance_per_px2

    @property
    def noise(self) -> gtsam.noiseModel.Base:
        """None more: the residual is whitened, since its covariance goes with the range."""
        return gtsam.noiseModel.Unit.Create(2)

    def residual(self, camera: Pose, sight: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As in the base class, in sigmas; for a camera at the place itself far off, with Jacobians of 0."""
        rotation, centre = camera
        local = rotation.T @ (self._place_m - centre)
        arm = local - sight[:3]
        distance = float(np.linalg.norm(arm))
        if distance < _NEAREST_M:
            return np.full(2, np.pi / _OPPOSITE), np.zeros((2, 6)), np.zeros((2, 6))
        p = arm / distance
        error, by_p, by_q = _turn(p, sight[3:], self.pixel.across)
        variance = self._variance_rad2 + self._variance_m2 / distance**2
        sigma = np.sqrt(variance)
        by_arm = by_p @ (np.eye(3) - np.outer(p, p)) / distance
        by_arm += np.outer(error * self._variance_m2 / (variance * distance**3), p)
        whitened = by_arm / sigma[:, None]
        by_camera = whitened @ np.hstack([skew(local), -np.eye(3)])
        return error / sigma, by_camera, np.hstack([-whitened, by_q / sigma[:, None]])


def mast_seen_factor(
    seen: Seen,
    world_T_mast: Slot,
    pan_tilt_rad: Slot,
    head_T_camera: PoseSlot,
    pan_T_tilt: PoseSlot,
    calibration: Slot,
    field: Slot,
    tilted_T_head: PoseSlot | None = None,
) -> gtsam.CustomFactor:
    """The factor of what a camera on the rigid mast sees (`mast_chain`).

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
        camera, twists = mast_chain(mast, pan_tilt, mount, axis, head)
        error, by_camera, by_entries, by_field = _seen(seen, camera, entries, field_px)
        by_mast, by_pan, by_down, by_axis, by_head = (by_camera @ twist for twist in twists)
        by_angles = np.concatenate([by_pan, -by_down], axis=2)
        rigid = by_mast, by_angles, by_camera, by_axis, by_entries, by_field
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
    return custom_factor(seen.noise, slots, residual)


def camera_seen_factor(seen: Seen, world_T_camera: Slot, calibration: Slot) -> gtsam.CustomFactor:
    """The factor of what a camera sees whose pose is a variable; no field is free."""

    def residual(camera: Pose, entries: FloatArray) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        error, by_camera, by_entries, _ = _seen(seen, camera, entries, np.zeros((1, 0)))
        return error, (by_camera, by_entries)

    return custom_factor(seen.noise, [(world_T_camera, "pose"), (calibration, "vector")], residual)


def _seen(
    seen: Seen, camera: Pose, entries: FloatArray, field_px: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residual (1, 2), and Jacobians (1, 2, k) by the camera, by entries of K, and by the field."""
    sight, by_entries, by_field = seen.pixel.sight(entries[0], field_px[0])
    error, by_camera, by_sight = seen.residual((camera[0][0], camera[1][0]), sight)
    return error[None], by_camera[None], (by_sight @ by_entries)[None], (by_sight @ by_field)[None]
