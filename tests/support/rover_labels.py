"""PDS labels of Curiosity and Perseverance, made from flight kinematics that is written out here.

z is down and axes are arbitrary, apart from the package's own chain. What they do not prove: that labels of
the archives are laid out as these are (the layout follows published ones), and that a flight unit follows
this kinematics; for Curiosity two published head poses say so, for Perseverance one says that the design
values are 1 mm and 2 mrad off.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHV, CAHVOR, CAHVORE
from pancam_graph.data import Traverse
from support.published_cameras import MODEL_B, MODEL_C

TOLERANCE = 1e-4  # metres and radians: what the reader promises
FLIP = np.diag([1.0, -1.0, -1.0])
POINTINGS = [(2.91281, 0.715421), (3.4, 1.1), (4.2, 1.3), (1.2, 0.9), (0.4, 1.5), (5.9, 0.6)]
"""Azimuth and elevation, radians, as the joints count them."""


@dataclass(frozen=True, kw_only=True)
class Mast:
    """Flight kinematics in the rover frame, z down: turns about lines, as mission documents have it."""

    azimuth_point: FloatArray
    azimuth_axis: FloatArray
    elevation_point: FloatArray
    """At home."""
    elevation_axis: FloatArray
    """At home."""
    home: tuple[float, float]

    def head(self, azimuth: float, elevation: float) -> tuple[FloatArray, FloatArray]:
        """Rotation of the head, which is the rover's at home, and where the elevation point goes."""
        turn = about(self.azimuth_axis, azimuth - self.home[0])
        lift = about(self.elevation_axis, elevation - self.home[1])
        return turn @ lift, self.azimuth_point + turn @ (self.elevation_point - self.azimuth_point)


def about(axis: FloatArray, angle: float) -> FloatArray:
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()


def msl_mast() -> Mast:
    """Curiosity: published in the mechanical frame, elevation axis at azimuth 0 (see `MSL_MAST`)."""
    to_nav = np.array([0.09002, 0.0, -1.1205])
    point, axis = np.array([0.714803, 0.559424, -1.109344]) + to_nav, np.array([-0.001, 0.0, 1.0])
    turn = about(axis, 3.167345)
    at_zero = np.array([0.714668, 0.561701, -0.785576]) + to_nav
    return Mast(
        azimuth_point=point,
        azimuth_axis=axis,
        elevation_point=point + turn @ (at_zero - point),
        elevation_axis=turn @ np.array([-0.022, -1.0, 0.0]),
        home=(3.167345, 1.588171),
    )


def mars2020_mast(*, as_designed: bool) -> Mast:
    """Perseverance: as designed, or with axes and zero points off by what a flight unit may be."""
    point = np.array([0.804037, 0.559028, -1.91927])
    off = 0.0 if as_designed else 1.0
    return Mast(
        azimuth_point=point + off * np.array([0.0007, -0.0004, 0.0002]),
        azimuth_axis=np.array([0.0, 0.0, 1.0]) + off * np.array([0.0012, -0.0009, 0.0]),
        elevation_point=point + off * np.array([0.0011, 0.0001, 0.0003]),
        elevation_axis=np.array([0.0, 1.0, 0.0]) + off * np.array([0.002, 0.0, -0.0018]),
        home=(2 * np.pi - 3.12414 + off * 0.0018, np.pi - 1.55334 - off * 0.0012),
    )


NAVCAM_B = replace(MODEL_B, width_px=8, height_px=6)
NAVCAM_B_JOINTS = (2.91281, 0.715421)
MARS2020_NAVCAM = replace(MODEL_C, width_px=8, height_px=6)


def turned(model: CAHV, rotation: FloatArray, shift: FloatArray) -> CAHV:
    """The model with its vectors turned and its centre moved."""
    moved = {"C": rotation @ model.C + shift}
    moved |= {name: rotation @ getattr(model, name) for name in "AHV"}
    if isinstance(model, CAHVOR):
        moved["O"] = rotation @ model.O
    vectors: dict[str, Any] = moved
    return replace(model, **vectors)


def navcam_b_head() -> CAHV:
    rotation, point = msl_mast().head(*NAVCAM_B_JOINTS)
    return turned(NAVCAM_B, rotation.T, -rotation.T @ point)


def numbers(values: Sequence[float] | FloatArray) -> str:
    return "( " + ",\r\n   ".join(f"{v:.6e}" for v in values) + " )"


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One image to write."""

    head: CAHV
    joints: tuple[float, float]
    instrument: str = "NAV_RIGHT_B"
    counter: tuple[int, int, int] = (4, 2100, 7)
    """Site, drive, mast."""
    offset: tuple[float, float, float] = (12.5, -3.25, -0.75)
    wxyz: tuple[float, float, float, float] = (0.98, 0.02, -0.03, 0.195)


def label_text(shot: Shot, mast: Mast, *, host: str = "MSL", image: str = "2") -> str:
    """A label with the groups of Curiosity, or of Perseverance (host M20)."""
    rotation, point = mast.head(*shot.joints)
    model = turned(shot.head, rotation, point)
    kind, letters = type(model).__name__, list(type(model).__name__)
    vectors = [numbers(getattr(model, letter)) for letter in letters]
    if isinstance(model, CAHVORE):
        letters += ["T", "P"]
        vectors += ["3.0", f"{model.linearity}"]
    parms = "_PARMS" if host == "MSL" else ""
    joints = (
        ("AZIMUTH-MEASURED", "ELEVATION-MEASURED", "AZIMUTH-REQUESTED", "ELEVATION-REQUESTED")
        if host == "MSL"
        else (
            "AZIMUTH FINAL-RESOLVER",
            "ELEVATION FINAL-RESOLVER",
            "AZIMUTH REQUESTED",
            "ELEVATION REQUESTED",
        )
    )
    az, el = shot.joints
    site, drive, moved = shot.counter
    components = "\r\n".join(f"  MODEL_COMPONENT_{i + 1} = {v}" for i, v in enumerate(vectors))
    return f"""{"PDS_VERSION_ID = PDS3" if host == "MSL" else "ODL_VERSION_ID = ODL3"}\r
/* FILE DATA ELEMENTS */\r
RECORD_TYPE = FIXED_LENGTH\r
RECORD_BYTES = 8192\r
^IMAGE = {image}\r
MSL:ACTIVE_FLIGHT_STRING_ID = B\r
GEOMETRY_PROJECTION_TYPE = {"LINEARIZED" if kind == "CAHV" else "RAW"}\r
INSTRUMENT_HOST_ID = {host}\r
INSTRUMENT_ID = {shot.instrument}\r
ROVER_MOTION_COUNTER_NAME = ("SITE", "DRIVE", "POSE",\r
                             "ARM", "RSM", "HGA")\r
ROVER_MOTION_COUNTER = ({site}, {drive}, 8, 22, {moved}, 144)\r
GROUP = GEOMETRIC_CAMERA_MODEL{parms}\r
  ^MODEL_DESC = "GEOMETRIC_CM.TXT"\r
  MODEL_TYPE = {kind}\r
  MODEL_COMPONENT_ID = ({", ".join(f'"{letter}"' for letter in letters)})\r
{components}\r
  REFERENCE_COORD_SYSTEM_NAME = ROVER_NAV_FRAME\r
END_GROUP = GEOMETRIC_CAMERA_MODEL{parms}\r
GROUP = ROVER_COORDINATE_SYSTEM{parms}\r
  MSL:SOLUTION_ID = telemetry\r
  COORDINATE_SYSTEM_NAME = ROVER_NAV_FRAME\r
  ORIGIN_OFFSET_VECTOR = {numbers(shot.offset)}\r
  ORIGIN_ROTATION_QUATERNION = {numbers(shot.wxyz)}\r
  REFERENCE_COORD_SYSTEM_NAME = SITE_FRAME\r
END_GROUP = ROVER_COORDINATE_SYSTEM{parms}\r
GROUP = RSM_ARTICULATION_STATE{parms}\r
  ARTICULATION_DEVICE_ID = "RSM"\r
  ARTICULATION_DEVICE_ANGLE_NAME = ("{joints[0]}", "{joints[1]}",\r
    "{joints[2]}"\r
    ,"{joints[3]}")\r
  ARTICULATION_DEVICE_ANGLE = ({az:.8f} <rad>, {el:.8f} <rad>,\r
    {az + 0.006:.6f} <rad>, {el + 0.004:.6f} <rad>)\r
END_GROUP = RSM_ARTICULATION_STATE{parms}\r
GROUP = ARM_ARTICULATION_STATE{parms}\r
  CONTACT_SENSOR_STATE = ("NO CONTACT","NO\r
CONTACT")\r
END_GROUP = ARM_ARTICULATION_STATE{parms}\r
OBJECT = IMAGE\r
  LINES = {model.height_px}\r
  LINE_SAMPLES = {model.width_px}\r
  SAMPLE_TYPE = UNSIGNED_INTEGER\r
  SAMPLE_BITS = 8\r
END_OBJECT = IMAGE\r
END\r
"""


def write(folder: Path, name: str, text: str, model: CAHV = NAVCAM_B) -> Path:
    """An image file of zeros with an attached label of one record."""
    file = folder / f"{name}.IMG"
    file.write_bytes(text.encode().ljust(8192) + bytes(model.width_px * model.height_px))
    return file


def label_poses(text: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centre, axis and rotation (columns: image x, y, axis) of a label's camera in the z-up site frame.

    Read from the text with regular expressions, z-down formulas written out: apart from the package.
    """

    def entry(group: str, key: str) -> FloatArray:
        body = re.search(rf"GROUP\s*=\s*{group}\w*\s(.*?)END_GROUP", text, re.DOTALL)
        assert body
        value = re.search(rf"{key}\s*=\s*\(([^)]*)\)", body[1])
        assert value
        return np.array([float(v) for v in value[1].split(",")])

    c, a, v = (entry("GEOMETRIC_CAMERA_MODEL", f"MODEL_COMPONENT_{k}") for k in (1, 2, 4))
    w, x, y, z = entry("ROVER_COORDINATE_SYSTEM", "ORIGIN_ROTATION_QUATERNION")
    site_R_rover = Rotation.from_quat([x, y, z, w]).as_matrix()
    offset = entry("ROVER_COORDINATE_SYSTEM", "ORIGIN_OFFSET_VECTOR")
    v_axis = v - (v @ a) / (a @ a) * a
    axis, down = a / np.linalg.norm(a), v_axis / np.linalg.norm(v_axis)
    rover_R_camera = np.column_stack([np.cross(down, axis), down, axis])
    return (
        FLIP @ (site_R_rover @ c + offset),
        FLIP @ site_R_rover @ axis,
        FLIP @ site_R_rover @ rover_R_camera,
    )


def misfits(traverse: Traverse) -> tuple[float, float, float]:
    """Largest miss of the labels' cameras: centre (m), axis (rad), whole rotation (rad)."""
    assert traverse.folder is not None
    rotations, centres = traverse.camera_poses()
    worst = np.zeros(3)
    for image, rotation, centre in zip(traverse.images, rotations, centres, strict=True):
        assert image.file is not None
        c, a, r = label_poses((traverse.folder / image.file).read_bytes()[:26000].decode("latin-1"))
        turn = Rotation.from_matrix(r.T @ rotation).magnitude()
        miss = [np.linalg.norm(centre - c), np.linalg.norm(np.cross(rotation[:, 2], a)), turn]
        worst = np.maximum(worst, miss)
    return float(worst[0]), float(worst[1]), float(worst[2])
