"""What is seen in known directions, as factors on the cameras of a template, through their real lenses."""

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import FIELD_COEFFICIENTS, FIELD_SHAPE, Fields, without_field
from pancam_graph.data import FrameDirection, Traverse
from pancam_graph.factors import (
    Fixed,
    Key,
    PoseSlot,
    SeenPixel,
    Slot,
    camera_direction_factor,
    mast_direction_factor,
)
from pancam_graph.graph._rig_variables import RigVariables

__all__ = ["direction_by_camera", "direction_by_mast", "require_in_sight"]

_IN_SIGHT = 3.0
"""Sigmas of telemetry by which a camera may be turned away from what it sees."""


def direction_by_mast(
    one: FrameDirection,
    rig: RigVariables,
    image: int,
    mast: Slot,
    pan_tilt: Slot,
    head: PoseSlot | None,
    plain_px: FloatArray,
) -> gtsam.CustomFactor:
    """The factor on mast, angles, flex and what is free of the rig; `plain_px` (2,) as for `SeenPixel`."""
    t = rig.traverse
    field: Slot = Fixed(np.zeros(0))
    by_field = None
    if rig.field_keys:
        eye = int(t.image_eye[image])
        field, by_field = Key(rig.field_keys[eye]), _field_rows(t, eye, one)
    pixel, calibration = _pixel(rig, image, plain_px, by_field)
    return mast_direction_factor(
        _noise(one, pixel),
        pixel,
        mast,
        pan_tilt,
        rig.mount_slot(image),
        rig.axis_slot(int(t.image_stop[image])),
        calibration,
        field,
        head,
        direction=one.direction,
    )


def direction_by_camera(
    one: FrameDirection, rig: RigVariables, image: int, camera: Slot, plain_px: FloatArray
) -> gtsam.CustomFactor:
    """The factor on the pose of the camera, and on its calibration where that is free."""
    pixel, calibration = _pixel(rig, image, plain_px, None)
    return camera_direction_factor(_noise(one, pixel), pixel, camera, calibration, direction=one.direction)


def require_in_sight(traverse: Traverse, one: FrameDirection, image: int, where: str) -> None:
    """Raise InputError for a pixel outside the domain of its lens, or a direction behind the camera.

    It lies there if it is a right angle or more off the line of sight, and telemetry is not that uncertain.
    """
    camera = traverse.rig.eyes[int(traverse.image_eye[image])].camera
    rays = camera.unproject(np.array([[one.u_px, one.v_px]]))
    if not rays.valid[0]:
        raise InputError(
            f"{where}: expected a pixel that the lens of {one.camera} has a line of sight for, found none at "
            f"({one.u_px:g}, {one.v_px:g})"
        )
    rotations, _ = traverse.camera_poses()
    cosine = float(rotations[image] @ rays.direction[0] @ one.direction)
    off = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    sigmas = [
        traverse.stops[int(traverse.image_stop[image])].sigma_rotation_rad,
        *traverse.frames[int(traverse.image_frame[image])].sigmas_rad,
    ]
    if off > max(np.pi / 2, _IN_SIGHT * float(np.linalg.norm(sigmas))):
        raise InputError(
            f"{where}: expected a direction in front of the camera, found one {np.degrees(off):.0f} degrees "
            "off its line of sight by telemetry (azimuths count anticlockwise from the world's x axis)"
        )


def _pixel(
    rig: RigVariables, image: int, plain_px: FloatArray, field: FloatArray | None
) -> tuple[SeenPixel, Slot]:
    """The pixel, and the slot of the free entries of its calibration."""
    t = rig.traverse
    lens = without_field(t.rig.eyes[int(t.image_eye[image])].camera).with_unit_calibration()
    variable = rig.variable("calibration", image)
    basis = None if variable is None else rig.basis("calibration")[image]
    slot: Slot = Fixed(np.zeros(0)) if variable is None else Key(variable.key)
    return SeenPixel(lens, t.calibration[image], plain_px, basis=basis, field=field), slot


def _noise(one: FrameDirection, pixel: SeenPixel) -> gtsam.noiseModel.Base:
    covariance = one.sigma_px**2 * pixel.covariance_per_px2 + one.sigma_rad**2 * np.eye(2)
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _field_rows(traverse: Traverse, eye: int, one: FrameDirection) -> FloatArray:
    """(2, coefficients) the field of an eye at the pixel, by its coefficients."""
    camera, first = traverse.rig.eyes[eye].camera, np.zeros(1, dtype=np.int64)
    size_px = np.array([[camera.width_px, camera.height_px]], dtype=float)
    fields = Fields(coefficients_px=np.zeros((1, *FIELD_SHAPE)), row=first, size_px=size_px)
    ((row, column),), (weight,) = fields.basis(first, np.array([[one.u_px, one.v_px]]))
    out = np.zeros((2, *FIELD_SHAPE))
    for k in (0, 1):
        out[k, k, row : row + 4, column : column + 4] = weight
    return out.reshape(2, FIELD_COEFFICIENTS)
