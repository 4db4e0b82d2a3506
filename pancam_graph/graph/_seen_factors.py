"""What cameras see in known directions and at known places, as factors, through their real lenses."""

import gtsam
import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import FIELD_COEFFICIENTS, FIELD_SHAPE, Fields, without_field
from pancam_graph.data import FrameDirection, FramePoint, FrameSeen, Traverse
from pancam_graph.factors import (
    Fixed,
    Key,
    PoseSlot,
    Seen,
    SeenDirection,
    SeenPixel,
    SeenPlace,
    Slot,
    camera_seen_factor,
    mast_seen_factor,
)
from pancam_graph.graph._rig_variables import RigVariables

__all__ = ["require_in_sight", "seen_by_camera", "seen_by_mast"]

_IN_SIGHT = 3.0
"""Sigmas of telemetry by which a camera may be turned away from what it sees."""
_LEAST_M = 1e-3
"""Range from which on a place has a direction."""


def seen_by_mast(
    one: FrameSeen,
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
    return mast_seen_factor(
        _seen(one, pixel),
        mast,
        pan_tilt,
        rig.mount_slot(image),
        rig.axis_slot(int(t.image_stop[image])),
        calibration,
        field,
        head,
    )


def seen_by_camera(
    one: FrameSeen, rig: RigVariables, image: int, camera: Slot, plain_px: FloatArray
) -> gtsam.CustomFactor:
    """The factor on the pose of the camera, and on its calibration where that is free."""
    pixel, calibration = _pixel(rig, image, plain_px, None)
    return camera_seen_factor(_seen(one, pixel), camera, calibration)


def require_in_sight(traverse: Traverse, one: FrameSeen, image: int, where: str) -> None:
    """Raise InputError for a pixel outside the domain of its lens, or what lies behind the camera.

    It lies there if it is a right angle or more off the line of sight, and telemetry is not that uncertain.
    """
    camera = traverse.rig.eyes[int(traverse.image_eye[image])].camera
    rays = camera.unproject(np.array([[one.u_px, one.v_px]]))
    if not rays.valid[0]:
        raise InputError(
            f"{where}: expected a pixel that the lens of {one.camera} has a line of sight for, found none at "
            f"({one.u_px:g}, {one.v_px:g})"
        )
    rotations, centres = traverse.camera_poses()
    stop = traverse.stops[int(traverse.image_stop[image])]
    sigmas = [stop.sigma_rotation_rad, *traverse.frames[int(traverse.image_frame[image])].sigmas_rad]
    if isinstance(one, FramePoint):
        arm = one.place_m - centres[image]
        distance = max(float(np.linalg.norm(arm)), _LEAST_M)
        direction = arm / distance
        sigmas.append(stop.sigma_translation_m / distance)
    else:
        assert isinstance(one, FrameDirection)  # there are no others
        direction = one.direction
    off = float(np.arccos(np.clip(rotations[image] @ rays.direction[0] @ direction, -1.0, 1.0)))
    if off > max(np.pi / 2, _IN_SIGHT * float(np.linalg.norm(sigmas))):
        what, hint = "place", ""
        if isinstance(one, FrameDirection):
            what, hint = "direction", " (azimuths count anticlockwise from the world's x axis)"
        raise InputError(
            f"{where}: expected a {what} in front of the camera, found one {np.degrees(off):.0f} degrees "
            f"off its line of sight by telemetry{hint}"
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


def _seen(one: FrameSeen, pixel: SeenPixel) -> Seen:
    if isinstance(one, FramePoint):
        return SeenPlace(pixel, one.place_m, sigma_px=one.sigma_px, sigma_m=one.sigma_m)
    assert isinstance(one, FrameDirection)  # there are no others
    return SeenDirection(pixel, one.direction, sigma_px=one.sigma_px, sigma_rad=one.sigma_rad)


def _field_rows(traverse: Traverse, eye: int, one: FrameSeen) -> FloatArray:
    """(2, coefficients) the field of an eye at the pixel, by its coefficients."""
    camera, first = traverse.rig.eyes[eye].camera, np.zeros(1, dtype=np.int64)
    size_px = np.array([[camera.width_px, camera.height_px]], dtype=float)
    fields = Fields(coefficients_px=np.zeros((1, *FIELD_SHAPE)), row=first, size_px=size_px)
    ((row, column),), (weight,) = fields.basis(first, np.array([[one.u_px, one.v_px]]))
    out = np.zeros((2, *FIELD_SHAPE))
    for k in (0, 1):
        out[k, k, row : row + 4, column : column + 4] = weight
    return out.reshape(2, FIELD_COEFFICIENTS)
