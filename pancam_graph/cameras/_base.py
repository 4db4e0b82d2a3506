"""The contract of every camera model: points to pixels, pixels to rays, both with derivatives."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pancam_graph.errors import CameraError
from pancam_graph.geometry import BoolArray, FloatArray

if TYPE_CHECKING:
    from pancam_graph.cameras._pinhole import Pinhole

__all__ = ["Camera", "Rays", "require_finite"]


@dataclass(frozen=True, kw_only=True)
class Rays:
    """Lines of sight of n pixels, in the frame of the camera's vectors."""

    origin_m: FloatArray
    """(n, 3) where each ray starts; one point for all but CAHVORE, whose entrance pupil moves."""
    direction: FloatArray
    """(n, 3) unit vectors towards the scene."""
    valid: BoolArray
    """(n,) False where a pixel lies outside the model's domain; its ray is then not meaningful."""


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
        """The pinhole of the same camera: what is left without distortion, with the same axes."""

    @abstractmethod
    def with_calibration(self, calibration: FloatArray) -> "Camera":
        """The same camera, distortion included, with another K (3, 3) of its pinhole.

        Raises CameraError for focal lengths that are not above 0.
        """

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


def require_finite(where: str, **numbers: float | FloatArray) -> None:
    """Raise CameraError naming the first entry that has a number which is not finite."""
    for name, value in numbers.items():
        if not np.all(np.isfinite(value)):
            raise CameraError(f"{where}: {name} must be finite, found {value}")
