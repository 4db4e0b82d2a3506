"""Pinhole with five numbers, and the same with Brown distortion."""

from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.cameras._base import Camera, Rays, require_finite
from pancam_graph.errors import CameraError
from pancam_graph.geometry import BoolArray, FloatArray

__all__ = ["Brown", "Pinhole"]

_MIN_DEPTH = 1e-9
_BROWN_STEPS = 50
_BROWN_TOLERANCE = 1e-14


@dataclass(frozen=True, kw_only=True)
class Pinhole(Camera):
    """Central projection with the upper-triangular calibration matrix K (thesis eq. 2.3)."""

    fx_px: float
    """Focal length in columns."""
    fy_px: float
    """Focal length in rows."""
    cx_px: float
    """Column of the principal point (x0 of the thesis)."""
    cy_px: float
    """Row of the principal point (y0 of the thesis)."""
    skew_px: float = 0.0
    """How far a unit of y moves the column (s of the thesis)."""

    def __post_init__(self) -> None:
        """Check the focal lengths."""
        super().__post_init__()
        require_finite("pinhole", fx_px=self.fx_px, fy_px=self.fy_px, cx_px=self.cx_px, cy_px=self.cy_px)
        require_finite("pinhole", skew_px=self.skew_px)
        if self.fx_px <= 0 or self.fy_px <= 0:
            raise CameraError(
                f"focal length: expected fx_px and fy_px above 0, found {self.fx_px} and {self.fy_px}"
            )

    @property
    def calibration_matrix(self) -> FloatArray:
        """K (3, 3), thesis eq. 2.3."""
        return np.array(
            [[self.fx_px, self.skew_px, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    @property
    def pinhole(self) -> "Pinhole":
        """The pinhole alone: of a pinhole itself, of a distorted camera the same K without distortion."""
        return Pinhole(
            width_px=self.width_px,
            height_px=self.height_px,
            fx_px=self.fx_px,
            fy_px=self.fy_px,
            cx_px=self.cx_px,
            cy_px=self.cy_px,
            skew_px=self.skew_px,
        )

    def with_calibration(self, calibration: FloatArray) -> "Pinhole":
        """The same camera with another K; see `Camera.with_calibration`."""
        k = calibration
        return replace(
            self,
            fx_px=float(k[0, 0]),
            fy_px=float(k[1, 1]),
            cx_px=float(k[0, 2]),
            cy_px=float(k[1, 2]),
            skew_px=float(k[0, 1]),
        )

    def distort(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted normalised coordinates (n, 2) and their derivative (n, 2, 2): here, none."""
        return xy, np.broadcast_to(np.eye(2), (len(xy), 2, 2))

    def undistort(self, xy_distorted: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Inverse of `distort`, and where it exists: here, everywhere."""
        return xy_distorted, np.ones(len(xy_distorted), dtype=bool)

    def _projected(
        self, points_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
        """Pixels, normalised coordinates, depths, the derivative of `distort`, and validity."""
        valid = points_m[:, 2] > _MIN_DEPTH
        z = np.where(valid, points_m[:, 2], 1.0)
        xy = points_m[:, :2] / z[:, None]
        xy_distorted, d_distort = self.distort(xy)
        k = self.calibration_matrix
        return xy_distorted @ k[:2, :2].T + k[:2, 2], xy, z, d_distort, valid

    def project(self, points_m: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) of points (n, 3) and their validity (n,); see `project_with_jacobian`."""
        uv, *_, valid = self._projected(points_m)
        return uv, valid

    def project_with_jacobian(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels, derivatives and validity; see `Camera.project_with_jacobian` (thesis eq. 2.2, 2.3)."""
        uv, xy, z, d_distort, valid = self._projected(points_m)
        k = self.calibration_matrix
        d_xy = np.zeros((len(z), 2, 3))
        d_xy[:, 0, 0] = d_xy[:, 1, 1] = 1 / z
        d_xy[:, :, 2] = -xy / z[:, None]
        return uv, k[:2, :2] @ d_distort @ d_xy, valid

    def project_with_calibration_jacobian(
        self, points_m: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels, their derivatives (n, 2, 5) by (fx, fy, s, x0, y0), and validity."""
        uv, _, valid = self.project_with_jacobian(points_m)
        z = np.where(valid, points_m[:, 2], 1.0)
        xy, _ = self.distort(points_m[:, :2] / z[:, None])
        d = np.zeros((len(z), 2, 5))
        d[:, 0, 0], d[:, 1, 1], d[:, 0, 2] = xy[:, 0], xy[:, 1], xy[:, 1]
        d[:, 0, 3] = d[:, 1, 4] = 1.0
        return uv, d, valid

    def _unprojected(self, uv_px: FloatArray) -> tuple[Rays, FloatArray, FloatArray, BoolArray]:
        """Rays, their lengths to depth 1, the derivative of `distort` there, and where it is singular."""
        k = self.calibration_matrix
        xy, valid = self.undistort((uv_px - k[:2, 2]) @ np.linalg.inv(k[:2, :2]).T)
        _, d = self.distort(xy)
        singular = np.abs(d[:, 0, 0] * d[:, 1, 1] - d[:, 0, 1] * d[:, 1, 0]) < 1e-12
        ray = np.column_stack([xy, np.ones(len(xy))])
        norm = np.linalg.norm(ray, axis=1)
        rays = Rays(origin_m=np.zeros((len(xy), 3)), direction=ray / norm[:, None], valid=valid & ~singular)
        return rays, norm, d, singular

    def unproject(self, uv_px: FloatArray) -> Rays:
        """Rays of pixels (n, 2); see `Rays`."""
        return self._unprojected(uv_px)[0]

    def unproject_with_jacobian(self, uv_px: FloatArray) -> tuple[Rays, FloatArray, FloatArray]:
        """Rays and their derivatives; see `Camera.unproject_with_jacobian`."""
        rays, norm, d_distort, singular = self._unprojected(uv_px)
        k_inverse = np.linalg.inv(self.calibration_matrix[:2, :2])
        d_xy = np.linalg.inv(np.where(singular[:, None, None], np.eye(2), d_distort)) @ k_inverse
        d_ray = np.concatenate([d_xy, np.zeros((len(norm), 1, 2))], axis=1)
        direction = rays.direction
        along = np.einsum("ni,nij->nj", direction, d_ray)
        d_direction = (d_ray - direction[:, :, None] * along[:, None, :]) / norm[:, None, None]
        return rays, np.zeros_like(d_direction), d_direction


@dataclass(frozen=True, kw_only=True)
class Brown(Pinhole):
    """Pinhole with Brown-Conrady distortion k1, k2, p1, p2, k3, in OpenCV's order and sense.

    Source: Brown, Close-range camera calibration, 1971; OpenCV's `projectPoints`.
    """

    distortion: tuple[float, float, float, float, float]
    """k1, k2 (radial), p1, p2 (tangential), k3 (radial), in normalised coordinates."""

    def __post_init__(self) -> None:
        """Check the coefficients."""
        super().__post_init__()
        if len(self.distortion) != 5:
            raise CameraError(
                f"distortion: expected k1, k2, p1, p2, k3, found {len(self.distortion)} numbers"
            )
        require_finite("brown", distortion=np.array(self.distortion))

    def distort(self, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted normalised coordinates (n, 2) and their derivative (n, 2, 2)."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        d_radial = k1 + r2 * (2 * k2 + r2 * 3 * k3)  # by r2
        out = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )
        d = np.empty((len(xy), 2, 2))
        d[:, 0, 0] = radial + 2 * x * x * d_radial + 2 * p1 * y + 6 * p2 * x
        d[:, 0, 1] = d[:, 1, 0] = 2 * x * y * d_radial + 2 * p1 * x + 2 * p2 * y
        d[:, 1, 1] = radial + 2 * y * y * d_radial + 6 * p1 * y + 2 * p2 * x
        return out, d

    def undistort(self, xy_distorted: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Inverse of `distort` by Newton's method, and where it converged to the undistorted side.

        Beyond the radius where the distortion folds back, no inverse exists and the point is invalid.
        """
        xy = xy_distorted.copy()
        for _ in range(_BROWN_STEPS):
            value, d = self.distort(xy)
            det = np.linalg.det(d)
            d = np.where((np.abs(det) < 1e-6)[:, None, None], np.eye(2), d)
            step = np.linalg.solve(d, (xy_distorted - value)[..., None])[..., 0]
            limit = np.maximum(1.0, np.linalg.norm(xy, axis=1))
            length = np.linalg.norm(step, axis=1)
            step *= np.minimum(1.0, limit / np.maximum(length, 1e-300))[:, None]
            xy = xy + step
            if np.all(length <= _BROWN_TOLERANCE * limit):
                break
        value, d = self.distort(xy)
        error = np.linalg.norm(value - xy_distorted, axis=1)
        return xy, (error < 1e-10) & (np.linalg.det(d) > 0)
