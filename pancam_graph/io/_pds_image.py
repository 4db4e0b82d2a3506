"""One PDS3 label, turned to z up: camera model, rover pose, measured mast angles."""

from pathlib import Path

import gtsam

from pancam_graph.base.errors import CameraError, GeometryError, InputError
from pancam_graph.base.geometry import FloatArray, pose_from_wxyz
from pancam_graph.base.text import visible
from pancam_graph.cameras import CAHV, CAHVORE_TYPES, cahv_of_vectors, cahvore_linearity
from pancam_graph.io._clock import plain_clock
from pancam_graph.io._labelled_image import LabelledImage
from pancam_graph.io._pds_label import LabelGroup, PdsLabel, read_label
from pancam_graph.io._pds_rover import ROVER_FRAMES, reference_frame
from pancam_graph.io._pds_rovers import rover_of
from pancam_graph.io._pds_samples import image_of_label
from pancam_graph.rigs import camera_z_up, pose_z_up

__all__ = ["read_labelled_image"]

_CAMERA_GROUPS = ("GEOMETRIC_CAMERA_MODEL", "GEOMETRIC_CAMERA_MODEL_PARMS")
_LONGEST_SERIAL = 40
_CLOCK = "SPACECRAFT_CLOCK_START_COUNT"
_SITE_GROUPS = ("SITE_COORDINATE_SYSTEM", "SITE_COORDINATE_SYSTEM_PARMS", "SITE_COORD_SYSTEM_PARMS")
_ROVER_GROUPS = ("ROVER_COORDINATE_SYSTEM", "ROVER_COORDINATE_SYSTEM_PARMS", "ROVER_COORD_SYSTEM_PARMS")


def read_labelled_image(file: Path) -> LabelledImage:
    """Read one image's label and check that its file is complete.

    Raises InputError naming file and entry for what is missing, malformed or not of a mast camera, and
    ImageError for a file shorter than its label says.
    """
    label = read_label(file)
    host, instrument = label.top.text("INSTRUMENT_HOST_ID").upper(), label.top.text("INSTRUMENT_ID").upper()
    rover = rover_of(
        host,
        instrument,
        where=label.label_file,
        host_entry="INSTRUMENT_HOST_ID",
        instrument_entry="INSTRUMENT_ID",
    )
    camera = label.group(*_CAMERA_GROUPS)
    layout = image_of_label(label).layout
    layout.require_complete()
    try:
        site_T_rover = _pose(label.group(*_ROVER_GROUPS), {"SITE_FRAME"})
        model = _camera_model(camera, layout.width_px, layout.height_px)
        frame = reference_frame(camera, ROVER_FRAMES | {"SITE_FRAME"})
        if frame == "SITE_FRAME":
            model = model.transformed(site_T_rover.inverse())
        pan_tilt_rad = rover.mast.pan_tilt_rad(*rover.joints_rad(label))
    except (CameraError, GeometryError) as error:
        raise InputError(f"{label.label_file}: {error}") from error
    counter, samples = label.counter(), label.group("IMAGE")
    for name in ("SITE", "DRIVE"):
        if name not in counter:
            raise InputError(
                f"{label.label_file}: ROVER_MOTION_COUNTER_NAME: expected SITE and DRIVE, "
                f"found {', '.join(counter)}"
            )
    return LabelledImage(
        file=label.file,
        label_file=label.label_file,
        host=host,
        instrument=instrument,
        stop=(counter["SITE"], counter["DRIVE"]),
        mast=rover.mast if rover.mast_of is None else rover.mast_of(label),
        uncertainty_of=rover.uncertainty_of,
        mast_counter=counter.get("PMA", counter.get("RSM")),
        clock_start=plain_clock(label.top.text(_CLOCK)) if _CLOCK in label.top.items else None,
        first_line_sample=(samples.integer("FIRST_LINE", 1), samples.integer("FIRST_LINE_SAMPLE", 1)),
        sample_bits=layout.sample_bits,
        pan_tilt_rad=pan_tilt_rad,
        world_T_rover=pose_z_up(site_T_rover),
        model=camera_z_up(model),
        serial=_serial(label),
        site_before_T_site=_site_pose(label, counter["SITE"]),
    )


def _site_pose(label: PdsLabel, site: int) -> gtsam.Pose3 | None:
    """The image's site in the frame of the site before it, z up; None where the label does not say that."""
    items = next((label.top.items[name] for name in _SITE_GROUPS if name in label.top.items), None)
    if not isinstance(items, dict):
        return None
    told = items.get("COORDINATE_SYSTEM_INDEX"), items.get("REFERENCE_COORD_SYSTEM_INDEX")
    if told != (site, site - 1):
        return None
    return pose_z_up(_pose(label.group(*_SITE_GROUPS), {"SITE_FRAME"}))


def _serial(label: PdsLabel) -> str:
    """INSTRUMENT_SERIAL_NUMBER, which labels write as a number or as text."""
    found = label.top.items.get("INSTRUMENT_SERIAL_NUMBER")
    return "" if found is None else visible(str(found)).strip()[:_LONGEST_SERIAL]


def _pose(group: LabelGroup, reference: set[str]) -> gtsam.Pose3:
    """`reference_T_frame` of a coordinate system group, z down."""
    reference_frame(group, reference)
    offset = group.numbers("ORIGIN_OFFSET_VECTOR", 3)
    wxyz = group.numbers("ORIGIN_ROTATION_QUATERNION", 4)
    try:
        return pose_from_wxyz(wxyz.tolist(), offset.tolist())
    except GeometryError as error:
        raise InputError(f"{group.where}: ORIGIN_ROTATION_QUATERNION: {error}") from error


def _camera_model(group: LabelGroup, width_px: int, height_px: int) -> CAHV:
    """The label's camera in the label's frame. Linearised products are CAHV and need nothing special."""
    kind = group.text("MODEL_TYPE").upper()
    letters = {"CAHV": "CAHV", "CAHVOR": "CAHVOR", "CAHVORE": "CAHVORETP"}
    if kind not in letters:
        raise InputError(f"{group.where}: MODEL_TYPE: expected CAHV, CAHVOR or CAHVORE, found {kind!r}")
    order = [name.upper() for name in group.names("MODEL_COMPONENT_ID")]
    vectors: dict[str, FloatArray] = {}
    for letter in letters[kind]:
        if letter not in order:
            raise InputError(
                f"{group.where}: MODEL_COMPONENT_ID: expected {', '.join(letters[kind])}, "
                f"found {', '.join(order)}"
            )
        entry = f"MODEL_COMPONENT_{order.index(letter) + 1}"
        vectors[letter] = group.numbers(entry, 1 if letter in "TP" else 3)
    linearity = _linearity(group, order, vectors) if kind == "CAHVORE" else 1.0
    vectors = {letter: vector for letter, vector in vectors.items() if letter not in "TP"}
    return cahv_of_vectors(width_px, height_px, vectors, linearity)


def _linearity(group: LabelGroup, order: list[str], vectors: dict[str, FloatArray]) -> float:
    """Linearity of a CAHVORE by its type T and its parameter P."""
    kind = int(vectors["T"][0])
    if kind not in CAHVORE_TYPES:
        raise InputError(
            f"{group.where}: MODEL_COMPONENT_{order.index('T') + 1}: expected a CAHVORE type of 1, 2 or 3, "
            f"found {vectors['T'][0]:g}"
        )
    return cahvore_linearity(kind, float(vectors["P"][0]))
