"""The contract of every camera model, and the pinhole, which each is without its distortion."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray
from pancam_graph.cameras._lens import MOUNT, Lens, LensField, linear_vectors

__all__ = ["PINHOLE_FIELDS", "PINHOLE_LENS", "Camera", "Pinhole", "Rays", "require_finite"]

_MIN_DEPTH = 1e-9


@dataclass(frozen=True, kw_only=True)
class Rays:
    """Lines of sight of n pixels, in the frame of the camera's vectors."""

    origin_m: FloatArray
    """(n, 3) where each ray starts; one point for all but CAHVORE, whose entrance pupil moves."""
    direction: FloatArray
    """(n, 3) unit vectors towards the scene."""
    valid: BoolArray
    """(n,) False where a pixel lies outside the model's domain; its ray is then not meaningful."""


_LARGEST_PX = 1_000_000
"""Pixels of the longest side of an image: far above any camera's."""


@dataclass(frozen=True, kw_only=True)
class Camera(ABC):
    """A camera model in its own frame: x right, y down, z forward, unless its vectors say otherwise.

    Pixels have the centre of the top-left pixel at (0, 0), u to the right, v down.
    """

    width_px: int
    """Columns of the image."""
    height_px: int
    """Rows of the image."""

    def __post_init__(self) -> None:
        """Check what every camera has."""
        if self.width_px < 1 or self.height_px < 1:
            raise CameraError(
                f"image size: expected at least 1 x 1 pixel, found {self.width_px} x {self.height_px}"
            )
        if max(self.width_px, self.height_px) > _LARGEST_PX:
            raise CameraError(
                f"image size: expected at most {_LARGEST_PX} pixels a side, found {self.width_px} x "
                f"{self.height_px}"
            )

    @abstractmethod
    def project_with_jacobian(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels of points, and how they move with the points.

        `points_m` is (n, 3). Returns pixels (n, 2), their derivatives (n, 2, 3) by the point, and
        validity (n,): False for points behind the camera or outside the model's domain, whose pixels
        and derivatives are finite but mean nothing. Nothing is clipped to the image.
        """

    @abstractmethod
    def unproject_with_jacobian(self, uv_px: FloatArray) -> tuple[Rays, FloatArray, FloatArray]:
        """Rays of pixels (n, 2), and how origin and direction (n, 3, 2 each) move with the pixel."""

    @property
    @abstractmethod
    def pinhole(self) -> "Pinhole":
        """The pinhole of the same camera: its projection without distortion, with the same axes."""

    @abstractmethod
    def with_calibration(self, calibration: FloatArray) -> "Camera":
        """The same camera, distortion included, with another K (3, 3) of its pinhole.

        Raises CameraError for focal lengths that are not above 0.
        """

    def with_unit_calibration(self) -> "Camera":
        """The same camera with a K of 1: its pixels are normalised coordinates after the distortion."""
        return self.with_calibration(np.eye(3))

    @property
    def pupil_moves(self) -> bool:
        """Whether rays of different pixels start at different points, so that near and far points differ."""
        return False

    def project(self, points_m: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) of points (n, 3) and their validity (n,); see `project_with_jacobian`."""
        uv_px, _, valid = self.project_with_jacobian(points_m)
        return uv_px, valid

    def unproject(self, uv_px: FloatArray) -> Rays:
        """Rays of pixels (n, 2); see `Rays`."""
        return self.unproject_with_jacobian(uv_px)[0]

    def contains(self, uv_px: FloatArray) -> BoolArray:
        """Which pixels (n, 2) lie on the image, edges of the outer pixels included."""
        size = np.array([self.width_px, self.height_px])
        return np.asarray(np.all((uv_px >= -0.5) & (uv_px <= size - 0.5), axis=-1))


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
    """Change of the column with a unit of y (s of the thesis)."""

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

    def in_domain(self, xy: FloatArray, d_distort: FloatArray) -> BoolArray:
        """Whether `distort` describes the lens at normalised coordinates (n, 2): here, everywhere.

        `d_distort` (n, 2, 2) is its derivative there.
        """
        return np.ones(len(xy), dtype=bool)

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
        valid &= self.in_domain(xy, d_distort)
        return xy_distorted @ k[:2, :2].T + k[:2, 2], xy, z, d_distort, valid

    def project(self, points_m: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) of points (n, 3) and their validity (n,); see `project_with_jacobian`."""
        uv, *_, valid = self._projected(points_m)
        return uv, valid

    def project_with_jacobian(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels, derivatives and validity; see `Camera.project_with_jacobian` (thesis eq. 2.2, 2.3)."""
        uv, xy, z, d_distort, valid = self._projected(points_m)
        # Products of a few numbers at each point are several times as fast written out as by matrices.
        k, d_point = self.calibration_matrix, np.empty((len(z), 2, 3))
        for i in range(2):
            along_x, along_y = (
                (k[i, 0] * d_distort[:, 0, j] + k[i, 1] * d_distort[:, 1, j]) / z for j in range(2)
            )
            d_point[:, i, 0], d_point[:, i, 1] = along_x, along_y
            d_point[:, i, 2] = -(along_x * xy[:, 0] + along_y * xy[:, 1])
        return uv, d_point, valid

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


PINHOLE_FIELDS = (
    *(LensField(key=key, attribute=key) for key in ("fx_px", "fy_px", "cx_px", "cy_px")),
    LensField(key="skew_px", attribute="skew_px", default=0.0),
    MOUNT,
)
"""The entries of a pinhole; a model with more than these lists its own after them."""

PINHOLE_LENS = Lens(
    name="pinhole",
    camera=Pinhole,
    fields=PINHOLE_FIELDS,
    cahv_vectors=lambda camera: linear_vectors(camera.calibration_matrix),
    distortion=None,
)


def require_finite(where: str, **numbers: float | FloatArray) -> None:
    """Raise CameraError naming the first entry that has a number which is not finite."""
    for name, value in numbers.items():
        if not np.all(np.isfinite(value)):
            raise CameraError(f"{where}: {name}: expected finite numbers, found {value}")
