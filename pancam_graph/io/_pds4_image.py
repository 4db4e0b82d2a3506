"""One PDS4 label of a rover of NASA, turned to z up: camera model, rover pose, measured mast angles.

Source: PDS4 dictionaries of geometry (geom) and imaging (img, img_surface), and a label of Perseverance
(sol 629).
"""

import re
from pathlib import Path

import gtsam

from pancam_graph.base.errors import CameraError, GeometryError, InputError
from pancam_graph.base.geometry import FloatArray, pose_from_wxyz
from pancam_graph.base.text import visible
from pancam_graph.cameras import CAHV, CAHVORE_TYPES, cahv_of_vectors, cahvore_linearity
from pancam_graph.io._clock import plain_clock
from pancam_graph.io._labelled_image import LabelledImage
from pancam_graph.io._pds4_samples import described_picture, pds4_host
from pancam_graph.io._pds_rover import ROVER_FRAMES, JointNames
from pancam_graph.io._pds_rovers import rover_of
from pancam_graph.io._xml import XmlElement
from pancam_graph.rigs import camera_z_up, pose_z_up

__all__ = ["motion_counter", "rover_image_of_xml"]

_SITE = "SITE_FRAME"
_VECTORS = {
    "C": ("Vector_Center", ("x_position", "y_position", "z_position"), "m"),
    "A": ("Vector_Axis", ("x_unit", "y_unit", "z_unit"), ""),
    "H": ("Vector_Horizontal", ("x_pixel", "y_pixel", "z_pixel"), "pixel"),
    "V": ("Vector_Vertical", ("x_pixel", "y_pixel", "z_pixel"), "pixel"),
    "O": ("Vector_Optical", ("x_unit", "y_unit", "z_unit"), ""),
    "R": ("Radial_Terms", ("c0", "c1", "c2"), ""),
    "E": ("Entrance_Terms", ("c0", "c1", "c2"), ""),
}
_INDEXED = re.compile(r"_\d.*")
"""Counters behind the name of a frame: ROVER_NAV_FRAME_30_1344_4."""
_LONGEST_SERIAL = 40


def rover_image_of_xml(root: XmlElement, picture: Path | None = None) -> LabelledImage:
    """The image that a label describes; its picture is the one that it names, or the one given.

    Raises InputError naming file and entry for what is missing, malformed or not of a mast camera, and
    ImageError for a picture that is missing, too short or of another size than its label says.
    """
    host = pds4_host(root)
    instrument = root.said("ops_instrument_key", root.said("instrument_id", "")).upper()
    if not instrument:
        instrument = _instrument_name(root)
    rover = rover_of(
        host,
        instrument,
        where=root.file,
        host_entry="Observing_System_Component: name",
        instrument_entry="ops_instrument_key",
    )
    if not isinstance(rover.joints, JointNames):
        raise InputError(
            f"{root.file}: expected a rover whose PDS4 labels have joints of the mast, found {host}"
        )
    file, width_px, height_px, bits = described_picture(root, picture)
    site_T_rover = _pose(_space(root, ROVER_FRAMES), {_SITE})
    try:
        model, frame = _camera_model(root.required("Camera_Model_Parameters"), width_px, height_px)
        if frame == _SITE:
            model = model.transformed(site_T_rover.inverse())
        pan_tilt_rad = rover.mast.pan_tilt_rad(*rover.joints.readings_rad(*_mast_angles(root)))
    except (CameraError, GeometryError) as error:
        raise InputError(f"{root.file}: {error}") from error
    counter = motion_counter(root)
    subframe = root.first("Subframe")
    return LabelledImage(
        file=file,
        label_file=root.file,
        host=rover.named.split(",")[0],
        instrument=instrument,
        serial=visible(root.said("instrument_serial_number", ""))[:_LONGEST_SERIAL],
        stop=(counter["SITE"], counter["DRIVE"]),
        mast=rover.mast,
        uncertainty_of=rover.uncertainty_of,
        mast_counter=counter.get("RSM"),
        clock_start=plain_clock(root.said("spacecraft_clock_start", "")),
        first_line_sample=(
            (1, 1)
            if subframe is None
            else (subframe.whole("first_line", 1), subframe.whole("first_sample", 1))
        ),
        sample_bits=bits,
        pan_tilt_rad=pan_tilt_rad,
        world_T_rover=pose_z_up(site_T_rover),
        model=camera_z_up(model),
        site_before_T_site=_site_pose(root, counter["SITE"]),
    )


def _instrument_name(root: XmlElement) -> str:
    for component in root.every("Observing_System_Component"):
        if component.said("type", "").lower() == "instrument":
            return component.said("name", "").upper().replace(" ", "_")
    return ""


def _frame(reference: XmlElement) -> str:
    """The frame that a Coordinate_Space_Reference or Coordinate_Space_Present names, without its counters."""
    told = reference.said("coordinate_space_frame_type", "") or reference.said(
        "local_identifier_reference", ""
    )
    return _INDEXED.sub("", told.upper())


def _space(root: XmlElement, frames: set[str]) -> XmlElement:
    """The first definition of one of these frames. Raises InputError if there is none."""
    for space in root.every("Coordinate_Space_Definition"):
        present = space.first("Coordinate_Space_Present")
        if present is not None and present.said("coordinate_space_frame_type", "").upper() in frames:
            return space
    raise InputError(
        f"{root.file}: expected a Coordinate_Space_Definition of {' or '.join(sorted(frames))}, found none"
    )


def _pose(space: XmlElement, references: set[str]) -> gtsam.Pose3:
    """`reference_T_frame` of a coordinate space, z down."""
    frame = _frame(space.required("Coordinate_Space_Reference"))
    if frame not in references:
        space.refuse(f"Coordinate_Space_Reference {' or '.join(sorted(references))}", repr(frame[:60]))
    turn = space.required("Quaternion_Plus_Direction")
    direction = turn.said("rotation_direction", "Forward")
    if direction != "Forward":
        turn.refuse("rotation_direction Forward", repr(direction[:60]))
    wxyz = [turn.required(name).number() for name in ("qcos", "qsin1", "qsin2", "qsin3")]
    offset = _origin(space)
    try:
        return pose_from_wxyz(wxyz, offset.tolist())
    except GeometryError as error:
        raise InputError(f"{space.file}: Quaternion_Plus_Direction: {error}") from error


def _origin(space: XmlElement) -> FloatArray:
    return space.vector("Vector_Origin_Offset", ("x_position", "y_position", "z_position"), "m")


def _camera_model(camera: XmlElement, width_px: int, height_px: int) -> tuple[CAHV, str]:
    """The label's camera, z down, and the frame in which it is."""
    kind = camera.said("model_type").upper()
    if kind not in {"CAHV", "CAHVOR", "CAHVORE"}:
        camera.refuse("model_type CAHV, CAHVOR or CAHVORE", repr(kind[:60]))
    terms = camera.required(f"{kind}_Model")
    vectors = {letter: terms.vector(*_VECTORS[letter]) for letter in kind}
    linearity = 1.0
    if kind == "CAHVORE":
        told = terms.whole("cahvore_model_type")
        if told not in CAHVORE_TYPES:
            terms.refuse("a cahvore_model_type of 1, 2 or 3", told)
        linearity = cahvore_linearity(told, terms.required("cahvore_model_parameter").number())
    frame = _frame(camera.required("Coordinate_Space_Reference"))
    if frame not in ROVER_FRAMES | {_SITE}:
        camera.refuse(
            f"Coordinate_Space_Reference {' or '.join(sorted(ROVER_FRAMES | {_SITE}))}", repr(frame[:60])
        )
    return cahv_of_vectors(width_px, height_px, vectors, linearity), frame


def _mast_angles(root: XmlElement) -> tuple[dict[str, float], str]:
    """Angles of the mast's joints by name, and the place in the label, for errors."""
    devices = root.every("Articulation_Device_Parameters")
    mast = next((device for device in devices if device.said("device_id", "").upper() == "RSM"), None)
    if mast is None:
        raise InputError(f"{root.file}: Articulation_Device_Parameters: expected the device RSM, found none")
    angles: dict[str, float] = {}
    holder = mast.required("Device_Angle")  # the first: those that were commanded follow it
    for entry in holder.every("Device_Angle_Index"):
        name, value = entry.said("index_id", "").upper(), entry.first("index_value_angle")
        if value is not None and name:
            angles.setdefault(name, value.angle_rad())
    return angles, f"{root.file}: Device_Angle: index_id"


def motion_counter(root: XmlElement) -> dict[str, int]:
    """The first motion counter that knows site and drive, by name."""
    found: dict[str, int] = {}
    for counter in root.every("Motion_Counter"):
        found = {
            entry.said("index_id", "").upper(): entry.whole("index_value_number")
            for entry in counter.every("Motion_Counter_Index")
        }
        if {"SITE", "DRIVE"} <= found.keys():
            return found
    raise InputError(
        f"{root.file}: Motion_Counter: expected SITE and DRIVE, found {', '.join(found)[:120] or 'none'}"
    )


def _site_pose(root: XmlElement, site: int) -> gtsam.Pose3 | None:
    """The image's site in the frame of the site before it, z up; None where that is not told."""
    for space in root.every("Coordinate_Space_Definition"):
        present, reference = (
            space.first("Coordinate_Space_Present"),
            space.first("Coordinate_Space_Reference"),
        )
        if present is None or reference is None or _frame(present) != _SITE or _frame(reference) != _SITE:
            continue
        own, before = present.first("index_value_number"), reference.first("index_value_number")
        if own is not None and before is not None and (own.text, before.text) == (str(site), str(site - 1)):
            return pose_z_up(_pose(space, {_SITE}))
    return None
