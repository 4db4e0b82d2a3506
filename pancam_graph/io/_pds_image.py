"""One rover image's label, turned to z up: camera model, rover pose, measured mast angles."""

from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from pancam_graph.base.errors import CameraError, GeometryError, InputError
from pancam_graph.base.geometry import Z_DOWN_R_Z_UP, FloatArray, pose_from_wxyz, rotation_from_wxyz
from pancam_graph.cameras import CAHV, cahv_of_vectors
from pancam_graph.io._pds_label import LabelGroup, PdsLabel, read_label
from pancam_graph.io._pds_samples import image_of_label
from pancam_graph.rigs import MARS2020_MAST, MER_MAST, MSL_MAST, MastKinematics

__all__ = ["PMA_GROUPS", "LabelledImage", "read_labelled_image"]

_ROVER_FRAMES = {"ROVER_FRAME", "ROVER_NAV_FRAME"}
_CAMERA_GROUPS = ("GEOMETRIC_CAMERA_MODEL", "GEOMETRIC_CAMERA_MODEL_PARMS")
_ROVER_GROUPS = ("ROVER_COORDINATE_SYSTEM", "ROVER_COORDINATE_SYSTEM_PARMS", "ROVER_COORD_SYSTEM_PARMS")
PMA_GROUPS = ("PMA_COORDINATE_SYSTEM", "PMA_COORDINATE_SYSTEM_PARMS")
_RSM_GROUPS = ("RSM_ARTICULATION_STATE", "RSM_ARTICULATION_STATE_PARMS")
_MAST_CAMERAS = ("PANCAM", "NAVCAM", "NAV_", "MAST_", "MCZ_", "ZCAM", "CHEMCAM", "SUPERCAM", "SCAM")
_HOSTS = {"MER": MER_MAST, "MSL": MSL_MAST, "M20": MARS2020_MAST, "MARS2020": MARS2020_MAST}
_Z_UP_T_Z_DOWN = gtsam.Pose3(gtsam.Rot3(Z_DOWN_R_Z_UP), np.zeros(3))


@dataclass(frozen=True, kw_only=True, eq=False)
class LabelledImage:
    """What a label says, z up, before images are sorted into stops, frames and eyes."""

    label: PdsLabel
    host: str
    instrument: str
    stop: tuple[int, int]
    """Site and drive."""
    mast: MastKinematics
    """As published; not yet moved to what the labels say."""
    mast_counter: int | None
    """How often the mast had moved; None where the label does not count."""
    pan_tilt_rad: tuple[float, float]
    """Measured, of the chain."""
    world_T_rover: gtsam.Pose3
    model: CAHV
    """In the rover frame."""


def read_labelled_image(file: Path) -> LabelledImage:
    """Read one image's label and check that its file is complete.

    Raises InputError naming file and entry for what is missing, malformed or not of a mast camera, and
    ImageError for a file shorter than its label says.
    """
    label = read_label(file)
    host = label.top.text("INSTRUMENT_HOST_ID").upper()
    instrument = label.top.text("INSTRUMENT_ID").upper()
    if not host.startswith(tuple(_HOSTS)):
        raise InputError(
            f"{label.label_file}: INSTRUMENT_HOST_ID: expected MER1, MER2, MSL or M20, found {host!r}"
        )
    if not instrument.startswith(_MAST_CAMERAS):
        raise InputError(
            f"{label.label_file}: INSTRUMENT_ID: expected a camera on the mast (PANCAM, NAVCAM, MAST, MCZ), "
            f"found {instrument!r}"
        )
    mast = next(mast for prefix, mast in _HOSTS.items() if host.startswith(prefix))
    camera = label.group(*_CAMERA_GROUPS)
    layout = image_of_label(label).layout
    layout.require_complete()
    try:
        site_T_rover = _pose(label.group(*_ROVER_GROUPS), {"SITE_FRAME"})
        model = _camera_model(camera, layout.width_px, layout.height_px)
        frame = _reference_frame(camera, _ROVER_FRAMES | {"SITE_FRAME"})
        if frame == "SITE_FRAME":
            model = model.transformed(site_T_rover.inverse())
        angles = _mast_angles(label, mast)
    except (CameraError, GeometryError) as error:
        raise InputError(f"{label.label_file}: {error}") from error
    counter = label.counter()
    for name in ("SITE", "DRIVE"):
        if name not in counter:
            raise InputError(
                f"{label.label_file}: ROVER_MOTION_COUNTER_NAME: expected SITE and DRIVE, "
                f"found {', '.join(counter)}"
            )
    return LabelledImage(
        label=label,
        host=host,
        instrument=instrument,
        stop=(counter["SITE"], counter["DRIVE"]),
        mast=mast,
        mast_counter=counter.get("PMA", counter.get("RSM")),
        pan_tilt_rad=angles,
        world_T_rover=_Z_UP_T_Z_DOWN * site_T_rover * _Z_UP_T_Z_DOWN,
        model=model.transformed(_Z_UP_T_Z_DOWN),
    )


def _reference_frame(group: LabelGroup, expected: set[str]) -> str:
    frame = group.text("REFERENCE_COORD_SYSTEM_NAME").upper()
    if frame not in expected:
        raise InputError(
            f"{group.where}: REFERENCE_COORD_SYSTEM_NAME: expected {' or '.join(sorted(expected))}, "
            f"found {frame!r}"
        )
    return frame


def _pose(group: LabelGroup, reference: set[str]) -> gtsam.Pose3:
    """`reference_T_frame` of a coordinate system group, z down."""
    _reference_frame(group, reference)
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
    """By T: 1 perspective, 2 fish-eye, 3 general with the linearity in P."""
    found = {1: 1.0, 2: 0.0, 3: float(vectors["P"][0])}.get(int(vectors["T"][0]))
    if found is None:
        raise InputError(
            f"{group.where}: MODEL_COMPONENT_{order.index('T') + 1}: expected a CAHVORE type of 1, 2 or 3, "
            f"found {vectors['T'][0]:g}"
        )
    return found


def _mast_angles(label: PdsLabel, mast: MastKinematics) -> tuple[float, float]:
    """Measured pan and tilt of the chain."""
    if mast is MER_MAST:
        # INSTRUMENT_ELEVATION changes its sign between rovers and the encoders have offsets; the
        # quaternion is what the camera model was made with.
        group = label.group(*PMA_GROUPS)
        _reference_frame(group, _ROVER_FRAMES)
        rotation = rotation_from_wxyz(group.numbers("ORIGIN_ROTATION_QUATERNION", 4))
        azimuth = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
        return mast.pan_tilt_rad(azimuth, float(np.arcsin(np.clip(-rotation[2, 0], -1, 1))))
    group = label.group(*_RSM_GROUPS)
    angles = group.angles_rad()
    found: list[float] = []
    for names in (mast.azimuth_names, mast.elevation_names):
        name = next((n for n in names if n in angles), None)
        if name is None:
            raise InputError(
                f"{group.where}: ARTICULATION_DEVICE_ANGLE_NAME: expected {' or '.join(names)} with a value, "
                f"found {', '.join(angles) or 'none'}"
            )
        found.append(angles[name])
    return mast.pan_tilt_rad(*found)
