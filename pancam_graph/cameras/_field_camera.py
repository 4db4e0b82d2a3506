"""A camera with its smooth distortion field: the one place where lens and field come together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pancam_graph.base.arrays import float_array
from pancam_graph.base.errors import CameraError
from pancam_graph.base.geometry import BoolArray, FloatArray, IntArray
from pancam_graph.cameras._camera import Camera, Pinhole, Rays, require_finite
from pancam_graph.cameras._field import FIELD_SHAPE, Fields

__all__ = ["FieldCamera", "fields_of", "with_added_field", "with_field", "with_field_of", "without_field"]

_ROUNDS = 20
_CLOSE = 1e-13
"""Largest step of the last round of an inverse that is valid, as a share of the pixel."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldCamera(Camera):
    """A camera model with a smooth distortion field on top: pixel = lens + field(pixel).

    Beyond the edges of the image the field is what it is at the edge. A pixel is invalid where it is of the
    lens, and where the field is so steep that two lines of sight could share it.
    """

    lens: Camera
    """The camera model without the field; of the same size."""
    field_px: FloatArray
    """(2, 7, 7) coefficients of the field, pixels (`Fields`)."""

    def __post_init__(self) -> None:
        """Check the field, and that it is the only one."""
        super().__post_init__()
        field_px = float_array("field_px", self.field_px, CameraError).copy()
        if field_px.shape != FIELD_SHAPE:
            expected, found = (" x ".join(map(str, shape)) for shape in (FIELD_SHAPE, field_px.shape))
            raise CameraError(f"field_px: expected {expected} numbers, found {found or 'one'}")
        require_finite("camera", field_px=field_px)
        field_px.flags.writeable = False
        object.__setattr__(self, "field_px", field_px)
        if isinstance(self.lens, FieldCamera):
            raise CameraError("lens: expected a camera without a field, found one with a field")
        sizes = [(c.width_px, c.height_px) for c in (self, self.lens)]
        if sizes[0] != sizes[1]:
            raise CameraError(f"lens: expected an image of the same size, found {sizes[1]} for {sizes[0]}")

    @property
    def pinhole(self) -> Pinhole:
        """The pinhole of the lens."""
        return self.lens.pinhole

    @property
    def pupil_moves(self) -> bool:
        """As of the lens."""
        return self.lens.pupil_moves

    def with_calibration(self, calibration: FloatArray) -> "FieldCamera":
        """The same lens with another K, and the same field."""
        return replace(self, lens=self.lens.with_calibration(calibration))

    def at(self, uv_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The field (n, 2) at pixels (n, 2) as measured, and its derivatives (n, 2, 2)."""
        fields, image = self._fields, self._image(uv_px)
        return fields.at(image, uv_px), fields.slope(image, uv_px)

    def project_with_jacobian(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Pixels, derivatives and validity; see `Camera.project_with_jacobian`."""
        plain, d_plain, valid = self.lens.project_with_jacobian(points_m)
        uv, there = self._displaced(plain)
        back, one_to_one = self._back(uv)
        valid = valid & there & one_to_one
        return uv, np.linalg.inv(back) @ d_plain, valid

    def project(self, points_m: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) of points (n, 3) and their validity (n,); see `project_with_jacobian`."""
        plain, valid = self.lens.project(points_m)
        uv, there = self._displaced(plain)
        return uv, valid & there

    def unproject(self, uv_px: FloatArray) -> Rays:
        """Rays of pixels (n, 2); see `Rays`."""
        return self.unproject_with_jacobian(uv_px)[0]

    def unproject_with_jacobian(self, uv_px: FloatArray) -> tuple[Rays, FloatArray, FloatArray]:
        """Rays and their derivatives; see `Camera.unproject_with_jacobian`."""
        plain = uv_px - self._fields.at(self._image(uv_px), uv_px)
        rays, d_origin, d_direction = self.lens.unproject_with_jacobian(plain)
        back, one_to_one = self._back(uv_px)
        return replace(rays, valid=rays.valid & one_to_one), d_origin @ back, d_direction @ back

    @property
    def _fields(self) -> Fields:
        size_px = np.array([[self.width_px, self.height_px]], dtype=float)
        return Fields(coefficients_px=self.field_px[None], row=np.zeros(1, dtype=np.int64), size_px=size_px)

    @staticmethod
    def _image(uv_px: FloatArray) -> IntArray:
        return np.zeros(len(uv_px), dtype=np.int64)

    def _back(self, uv_px: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Derivative (n, 2, 2) of pixels of the lens by pixels as measured; whether it is one to one (n,)."""
        back = np.eye(2) - self.at(uv_px)[1]
        one_to_one = np.linalg.det(back) > 0
        return np.where(one_to_one[:, None, None], back, np.eye(2)), one_to_one

    def _displaced(self, plain_px: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, 2) as measured of pixels (n, 2) of the lens, and whether they were found (n,)."""
        fields, image = self._fields, self._image(plain_px)
        close = _CLOSE * (1e3 + np.abs(plain_px).max(axis=1, initial=0.0))
        uv, step = plain_px, np.zeros(len(plain_px))
        # A field is flat: each round is a hundred times closer or more.
        for _ in range(_ROUNDS):
            moved = plain_px + fields.at(image, uv)
            step = np.abs(moved - uv).max(axis=1, initial=0.0)
            uv = moved
            if not (step > close).any():
                break
        return uv, step <= close


def fields_of(cameras: Sequence[Camera], image_camera: IntArray) -> Fields | None:
    """The fields of images that each of some cameras took, by the camera's index (n,).

    None where no camera has a field.
    """
    if not any(isinstance(camera, FieldCamera) for camera in cameras):
        return None
    size_px = np.array([[c.width_px, c.height_px] for c in cameras], dtype=float)
    return Fields(
        coefficients_px=np.array([_coefficients_px(camera) for camera in cameras]),
        row=image_camera,
        size_px=size_px[image_camera],
    )


def with_field(camera: Camera, field_px: FloatArray | None) -> Camera:
    """A camera's lens with the field of these coefficients in place of its own; None, or zeros: with none."""
    lens = without_field(camera)
    if field_px is None or not np.any(field_px):
        return lens
    return FieldCamera(width_px=lens.width_px, height_px=lens.height_px, lens=lens, field_px=field_px)


def with_added_field(camera: Camera, field_px: FloatArray) -> Camera:
    """A camera whose field has these coefficients (2, 7, 7), pixels, more than it had."""
    return with_field(camera, _coefficients_px(camera) + field_px)


def with_field_of(lens: Camera, other: Camera) -> Camera:
    """A lens with the field of another camera, or without one where that has none."""
    return with_field(lens, other.field_px if isinstance(other, FieldCamera) else None)


def without_field(camera: Camera) -> Camera:
    """The lens of a camera without its field."""
    return camera.lens if isinstance(camera, FieldCamera) else camera


def _coefficients_px(camera: Camera) -> FloatArray:
    return camera.field_px if isinstance(camera, FieldCamera) else np.zeros(FIELD_SHAPE)
