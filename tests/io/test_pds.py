"""PDS labels to a traverse: real Opportunity images, and labels of Curiosity and Perseverance made here.

The made labels follow the flight kinematics written out below, z down and about arbitrary axes, apart
from the package's own chain. What they do not prove: that labels of the archives are laid out as
these are (the layout follows published ones), and that a flight unit follows this kinematics; for
Curiosity two published head poses say so, for Perseverance one says that the design values are 1 mm
and 2 mrad off.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.base.geometry import FloatArray, pan_tilt_rotation, rotation_from_wxyz, wxyz_from_rotation
from pancam_graph.cameras import CAHV, CAHVOR, CAHVORE
from pancam_graph.data import Traverse
from pancam_graph.io import read_pds
from pancam_graph.io._pds import LOCALISATION_SIGMA
from pancam_graph.io._pds_label import read_label
from pancam_graph.rigs import MARS2020_MAST, MSL_MAST, MastKinematics
from support.published_cameras import MODEL_B, MODEL_C

TOLERANCE = 1e-4  # metres and radians: what the reader promises
FLIP = np.diag([1.0, -1.0, -1.0])


# --- Labels made here ------------------------------------------------------------------------------


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


# --- Opportunity ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def opportunity(opportunity_folder: Path) -> Traverse:
    return read_pds(opportunity_folder)


def test_opportunity_is_one_stop_five_frames_one_eye(opportunity: Traverse, opportunity_folder: Path) -> None:
    traverse = opportunity
    assert [s.id for s in traverse.stops] == ["site195-drive973"]
    assert (traverse.stops[0].sigma_rotation_rad, traverse.stops[0].sigma_translation_m) == (0.0, 0.0)
    assert [f.id for f in traverse.frames] == [f"195-973-{k}" for k in (25, 26, 28, 29, 30)]
    assert [e.name for e in traverse.rig.eyes] == ["navcam-left"]
    camera = traverse.rig.eyes[0].camera
    assert type(camera) is CAHVOR
    assert (camera.width_px, camera.height_px) == (1024, 1024)
    assert traverse.observations is None
    assert traverse.folder == opportunity_folder
    assert all(i.file and (opportunity_folder / i.file).is_file() for i in traverse.images)
    assert traverse.warnings == ()


def test_opportunity_rig_reproduces_the_labels(opportunity: Traverse) -> None:
    centre, axis, rotation = misfits(opportunity)
    assert centre < 5e-6
    assert axis < 5e-6
    assert rotation < 5e-6


def test_opportunity_angles_are_the_encoders_plus_their_offsets(
    opportunity: Traverse, opportunity_folder: Path
) -> None:
    # Pan is anticlockwise, the label's azimuth clockwise. The encoders' offsets, 0.267 and
    # 3.59 degrees, were measured on these very labels: the test proves signs and names, not the offsets.
    traverse = opportunity
    for frame, image in zip(traverse.frames, traverse.images, strict=True):
        measured = (
            read_label(opportunity_folder / str(image.file)).group("PMA_ARTICULATION_STATE").angles_rad()
        )
        pan = -measured["AZIMUTH-MEASURED"] - np.deg2rad(0.267)
        tilt = measured["ELEVATION-MEASURED"] + np.deg2rad(3.59)
        assert frame.pan_rad == pytest.approx(pan, abs=2e-4)
        assert frame.tilt_rad == pytest.approx(tilt, abs=2e-4)
        assert frame.sigma_pan_rad == pytest.approx(np.deg2rad(0.077))


def test_opportunity_projects_as_its_labels_do(opportunity: Traverse, opportunity_folder: Path) -> None:
    # Through the whole chain: points of the world to pixels, by the rig and by each label's own vectors.
    traverse = opportunity
    rotations, centres = traverse.camera_poses()
    camera = traverse.rig.eyes[0].camera
    pixels = np.array([[100.0, 200.0], [512.0, 512.0], [900.0, 1000.0], [50.0, 980.0]])
    for image, rotation, centre in zip(traverse.images, rotations, centres, strict=True):
        label = read_label(opportunity_folder / str(image.file))
        group, rover = label.group("GEOMETRIC_CAMERA_MODEL"), label.group("ROVER_COORDINATE_SYSTEM")
        c, a, h, v, o, r = (group.numbers(f"MODEL_COMPONENT_{k}", 3) for k in range(1, 7))
        model = CAHVOR(width_px=1024, height_px=1024, C=c, A=a, H=h, V=v, O=o, R=r)
        points = centre + 20 * (camera.unproject(pixels).direction @ rotation.T)
        site_R_rover = rotation_from_wxyz(rover.numbers("ORIGIN_ROTATION_QUATERNION", 4))
        in_rover = (points @ FLIP - rover.numbers("ORIGIN_OFFSET_VECTOR", 3)) @ site_R_rover
        found, valid = model.project(in_rover)
        assert valid.all()
        np.testing.assert_allclose(found, pixels, atol=0.02)


# --- Kinematics against published numbers -------------------------------------------------------------


@pytest.mark.parametrize(
    ("joints", "origin", "wxyz"),
    [  # RSM_COORDINATE_SYSTEM_PARMS of two published Mastcam labels, sols 1664 and 2264
        (
            (5.367043, 0.727572),
            (0.804581, 0.559312, -1.906076),
            (0.4123769, 0.3716305, -0.1878729, 0.8102714),
        ),
        (
            (2.719078, 0.542313),
            (0.804374, 0.559484, -1.906076),
            (0.8446875, -0.1089795, -0.4873414, -0.1926783),
        ),
    ],
)
def test_curiosity_axes_give_the_published_head_poses(
    joints: tuple[float, float], origin: Sequence[float], wxyz: Sequence[float]
) -> None:
    rotation, centre = chain_head(MSL_MAST, joints)
    np.testing.assert_allclose(centre, FLIP @ origin, atol=2e-6)
    label_R = FLIP @ rotation_from_wxyz(wxyz) @ FLIP
    assert Rotation.from_matrix(label_R.T @ rotation).magnitude() < 2e-6


def test_perseverance_axes_as_designed_are_near_a_published_head_pose() -> None:
    # Navcam label of sol 629: the design is 1.1 mm and some milliradians off, so read_pds must fit.
    rotation, centre = chain_head(MARS2020_MAST, (5.10068, 1.4108))
    assert np.linalg.norm(centre - FLIP @ [0.804941, 0.559508, -1.91903]) == pytest.approx(1.05e-3, abs=1e-4)
    label_R = FLIP @ rotation_from_wxyz((0.563254, 0.071888, -0.0507901, 0.821582)) @ FLIP
    assert 1e-3 < Rotation.from_matrix(label_R.T @ rotation).magnitude() < 4e-3


def test_curiosity_navcam_is_where_its_published_label_says() -> None:
    """Vector B: the right Navcam's centre in the head frame, carried to the rover frame by its encoders.

    The head-frame centre is known to 0.05 mm, so this proves no more than that. The axis A has no
    published head-frame value: it is only shown to look where the head looks, to within half a degree.
    """
    rotation, centre = chain_head(MSL_MAST, NAVCAM_B_JOINTS)
    found = FLIP @ (centre + rotation @ FLIP @ [0.1141, 0.2096, -0.0341])
    np.testing.assert_allclose(found, NAVCAM_B.C, atol=1e-4)
    axis = FLIP @ rotation[:, 0]
    assert np.linalg.norm(np.cross(axis, NAVCAM_B.A)) < np.deg2rad(0.5)


def chain_head(mast: MastKinematics, joints: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """The head in the z-up rover frame by the package's chain; at home its rotation is the rover's."""
    rover_T_mast, pan_T_tilt = mast.chain()
    pan, tilt = mast.pan_tilt_rad(*joints)
    mast_R, axis_R = rover_T_mast.rotation().matrix(), pan_T_tilt.rotation().matrix()
    turn = pan_tilt_rotation(pan, 0.0)
    rotation = mast_R @ turn @ axis_R @ pan_tilt_rotation(0.0, tilt) @ (mast_R @ axis_R).T
    return rotation, rover_T_mast.translation() + mast_R @ turn @ pan_T_tilt.translation()


# --- Labels of Curiosity and Perseverance -------------------------------------------------------------

POINTINGS = [(2.91281, 0.715421), (3.4, 1.1), (4.2, 1.3), (1.2, 0.9), (0.4, 1.5), (5.9, 0.6)]


def test_curiosity_frames_of_two_eyes_and_two_stops(tmp_path: Path) -> None:
    right = navcam_b_head()
    left = replace(right, C=right.C - np.array([0.0, 0.4239, 0.0]), H=right.H * 1.001)
    mast = msl_mast()
    for k, joints in enumerate(POINTINGS):
        for name, head in (("NLB", left), ("NRB", right)):
            shot = Shot(
                head=head,
                joints=joints,
                instrument="NAV_LEFT_B" if name == "NLB" else "NAV_RIGHT_B",
                counter=(4, 2100 if k < 4 else 2106, 7 + k),
                offset=(12.5, -3.25, -0.75) if k < 4 else (15.5, 0.75, -0.75),
            )
            write(tmp_path, f"{name}_{k}", label_text(shot, mast))
    traverse = read_pds(tmp_path)
    assert [s.id for s in traverse.stops] == ["site4-drive2100", "site4-drive2106"]
    assert traverse.stops[0].sigma_translation_m == 0.0
    assert traverse.stops[1].sigma_translation_m == pytest.approx(0.1 + 0.05 * 5.0)
    assert traverse.stops[1].sigma_rotation_rad == LOCALISATION_SIGMA.rotation_rad
    assert [e.name for e in traverse.rig.eyes] == ["nav-left-b", "nav-right-b"]
    assert [f.id for f in traverse.frames] == [f"4-{2100 if k < 4 else 2106}-{7 + k}" for k in range(6)]
    assert {i.id: i.frame for i in traverse.images}["NRB_3"] == "4-2100-10"
    assert traverse.warnings == ()
    assert max(misfits(traverse)) < 1e-5
    # The mast's z is the pan axis, which leans by 1 mrad in the rover.
    rover_R = FLIP @ rotation_from_wxyz((0.98, 0.02, -0.03, 0.195)) @ FLIP
    lean = rover_R.T @ traverse.stops[0].world_T_mast.rotation().matrix()[:, 2]
    np.testing.assert_allclose(lean, [1e-3, 0.0, 1.0], atol=1e-6)
    # Angles are the measured ones: encoders less the joints' zero points.
    pan = np.array([f.pan_rad for f in traverse.frames])
    np.testing.assert_allclose(pan, [3.167345 - az for az, _ in POINTINGS], atol=1e-7)
    assert traverse.frames[1].tilt_rad == pytest.approx(1.1 - 1.588171, abs=1e-7)
    assert traverse.frames[0].sigma_pan_rad == pytest.approx(np.deg2rad(0.063))


@pytest.mark.parametrize("as_designed", [True, False])
def test_perseverance_axes_are_fitted_where_the_design_does_not_hold(
    tmp_path: Path, as_designed: bool
) -> None:
    mast = mars2020_mast(as_designed=as_designed)
    for k, joints in enumerate(POINTINGS):
        shot = Shot(head=MARS2020_NAVCAM, joints=joints, instrument="NAVCAM_LEFT", counter=(30, 1344, k))
        write(tmp_path, f"NLF_{k}", label_text(shot, mast, host="M20"))
    traverse = read_pds(tmp_path)
    assert type(traverse.rig.eyes[0].camera) is CAHVORE
    assert traverse.warnings == ()
    assert max(misfits(traverse)) < (1e-5 if as_designed else TOLERANCE)
    found = traverse.rig.eyes[0].head_model()
    assert isinstance(found, CAHVORE)
    np.testing.assert_allclose(found.C, FLIP @ MARS2020_NAVCAM.C, atol=5e-3)
    np.testing.assert_allclose((found.E, found.R), (MARS2020_NAVCAM.E, MARS2020_NAVCAM.R), atol=1e-6)
    # Six pointings tell the pan axis: the mast's z in the rover is it.
    rover_R = FLIP @ rotation_from_wxyz((0.98, 0.02, -0.03, 0.195)) @ FLIP
    pan_axis = rover_R.T @ traverse.stops[0].world_T_mast.rotation().matrix()[:, 2]
    np.testing.assert_allclose(pan_axis, -FLIP @ mast.azimuth_axis, atol=1e-5)


def test_few_pointings_are_enough_for_the_cameras_if_not_for_the_axes(tmp_path: Path) -> None:
    for k, joints in enumerate(POINTINGS[:2]):
        shot = Shot(head=MARS2020_NAVCAM, joints=joints, instrument="NAVCAM_LEFT", counter=(30, 1344, k))
        write(tmp_path, f"NLF_{k}", label_text(shot, mars2020_mast(as_designed=False), host="M20"))
    traverse = read_pds(tmp_path)
    assert max(misfits(traverse)) < TOLERANCE
    assert traverse.warnings == ()


def test_a_label_turned_by_hand_moves_its_frame_alone_and_is_reported(tmp_path: Path) -> None:
    mast = msl_mast()
    for k, (az, el) in enumerate(POINTINGS):
        shot = Shot(head=navcam_b_head(), joints=(az, el), counter=(4, 2100, k))
        text = label_text(shot, mast)
        if k == 2:  # the camera was pointed 8 mrad further than telemetry says
            text = text.replace(f"({az:.8f} <rad>", f"({az - 8e-3:.8f} <rad>")
        write(tmp_path, f"NRB_{k}", text)
    traverse = read_pds(tmp_path)
    assert max(misfits(traverse)) < TOLERANCE
    assert len(traverse.warnings) == 1
    assert re.match(r"1 of 6 pointings: .* at most 8\.\d mrad in NRB_2\.IMG", traverse.warnings[0])


def test_a_camera_that_no_pointing_explains_is_reported_with_numbers(tmp_path: Path) -> None:
    mast = msl_mast()
    for k, joints in enumerate(POINTINGS):
        head = navcam_b_head()
        if k == 1:
            head = replace(head, C=head.C + np.array([0.02, 0.03, -0.02]))
        write(tmp_path, f"NRB_{k}", label_text(Shot(head=head, joints=joints, counter=(4, 2100, k)), mast))
    traverse = read_pds(tmp_path)
    assert any(re.search(r"worst \d+\.\d\d mm and \d+\.\d\d mrad in NRB_", w) for w in traverse.warnings)


def test_other_sizes_zooms_and_subframes_are_other_eyes(tmp_path: Path) -> None:
    head, mast = navcam_b_head(), msl_mast()
    variants = [
        head,
        replace(head, width_px=4),
        replace(head, H=head.H + 100 * head.A),
        replace(head, H=2 * head.H, V=2 * head.V),
    ]
    for k, model in enumerate(variants):
        shot = Shot(head=model, joints=POINTINGS[0], counter=(4, 2100, 7))
        write(tmp_path, f"NRB_{k}", label_text(shot, mast), model)
    linear = CAHV(width_px=8, height_px=6, C=head.C, A=head.A, H=head.H, V=head.V)
    write(tmp_path, "NRB_4", label_text(Shot(head=linear, joints=POINTINGS[0]), mast))
    traverse = read_pds(tmp_path)
    names = ["nav-right-b", *(f"nav-right-b-{k}" for k in range(2, 6))]
    assert [i.camera for i in traverse.images] == names
    assert len(traverse.frames) == 1
    assert type(traverse.rig.eyes[4].camera) is CAHV
    assert max(misfits(traverse)) < TOLERANCE


def test_an_eye_looks_once_in_a_frame(tmp_path: Path) -> None:
    shot = Shot(head=navcam_b_head(), joints=POINTINGS[0])
    for k in range(2):
        write(tmp_path, f"NRB_{k}", label_text(shot, msl_mast()))
    traverse = read_pds(tmp_path)
    assert [f.id for f in traverse.frames] == ["4-2100-7", "4-2100-7.2"]


def test_detached_labels_are_read(tmp_path: Path) -> None:
    text = label_text(Shot(head=navcam_b_head(), joints=POINTINGS[0]), msl_mast(), image='("NRB_0.IMG", 1)')
    (tmp_path / "NRB_0.LBL").write_text(text)
    (tmp_path / "NRB_0.IMG").write_bytes(bytes(48))
    assert read_pds(tmp_path).images[0].file == "NRB_0.IMG"


def test_camera_models_in_the_site_frame_are_turned_to_the_rover(tmp_path: Path) -> None:
    shot = Shot(head=navcam_b_head(), joints=POINTINGS[1])
    plain = label_text(shot, msl_mast())
    write(tmp_path, "NRB_0", plain)
    expected = read_pds(tmp_path).camera_poses()
    site_R_rover, offset = rotation_from_wxyz(shot.wxyz), np.array(shot.offset)
    rotation, point = msl_mast().head(*shot.joints)
    in_site = turned(shot.head, site_R_rover @ rotation, site_R_rover @ point + offset)
    text = plain.replace(
        "REFERENCE_COORD_SYSTEM_NAME = ROVER_NAV_FRAME", "REFERENCE_COORD_SYSTEM_NAME = SITE_FRAME"
    )
    for k, letter in enumerate("CAHVO", start=1):
        text = re.sub(
            rf"MODEL_COMPONENT_{k} = \([^)]*\)",
            f"MODEL_COMPONENT_{k} = {numbers(getattr(in_site, letter))}",
            text,
        )
    write(tmp_path, "NRB_0", text)
    found = read_pds(tmp_path).camera_poses()
    np.testing.assert_allclose(found[0], expected[0], atol=1e-5)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-5)


def test_rover_poses_that_differ_within_a_stop_are_reported(tmp_path: Path) -> None:
    for k in range(2):
        shot = Shot(
            head=navcam_b_head(),
            joints=POINTINGS[k],
            counter=(4, 2100, k),
            offset=(12.5 + 0.02 * k, 0.0, 0.0),
        )
        write(tmp_path, f"NRB_{k}", label_text(shot, msl_mast()))
    (warning,) = read_pds(tmp_path).warnings
    assert warning.startswith(
        "stop site4-drive2100: its labels' rover poses differ by up to 20.0 mm and 0.0 mrad"
    )


def test_angles_may_be_in_degrees_and_values_over_several_lines(tmp_path: Path) -> None:
    az, el = POINTINGS[0]
    text = label_text(Shot(head=navcam_b_head(), joints=(az, el)), msl_mast())
    degrees = f"({np.rad2deg(az):.8f} <deg>,\r\n{np.rad2deg(el):.8f}\r\n <deg>"
    text = text.replace(f"({az:.8f} <rad>, {el:.8f} <rad>", degrees)
    # Layout seen in published labels: a value on the next line, lists of one, dates with day of year.
    quirks = (
        'SOURCE_PRODUCT_ID =\r\n"McamRRecoveredProduct_0562880080-46707-1"\r\n'
        "STOP_TIME = 2022-331T01:08:36.002\r\n"
        "GROUP = SITE_COORDINATE_SYSTEM_PARMS\r\n COORDINATE_SYSTEM_INDEX = (62 )\r\n"
        "END_GROUP = SITE_COORDINATE_SYSTEM_PARMS\r\nMSL:CALIBRATION_FILE_NAME = (N/A )\r\nINSTRUMENT_HOST_ID"
    )
    write(tmp_path, "NRB_0", text.replace("INSTRUMENT_HOST_ID", quirks, 1))
    frame = read_pds(tmp_path).frames[0]
    assert frame.pan_rad == pytest.approx(3.167345 - az, abs=1e-9)
    assert frame.tilt_rad == pytest.approx(el - 1.588171, abs=1e-9)


# --- Bad input ---------------------------------------------------------------------------------------


def changed(pattern: str, by: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        out, count = re.subn(pattern, by, text, count=1, flags=re.DOTALL)
        assert count == 1
        return out

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            changed(r"GROUP = GEOMETRIC.*?END_GROUP = GEO\w*", ""),
            "expected a group GEOMETRIC_CAMERA_MODEL or GEOMETRIC_CAMERA_MODEL_PARMS, found none",
        ),
        (changed(r"GROUP = ROVER.*?END_GROUP = ROV\w*", ""), "expected a group ROVER_COORDINATE_SYSTEM or"),
        (changed(r"GROUP = RSM.*?END_GROUP = RSM\w*", ""), "expected a group RSM_ARTICULATION_STATE or"),
        (changed("AZIMUTH-MEASURED", "AZ"), "_ANGLE_NAME: expected AZIMUTH-MEASURED or AZIMUTH-FINAL with"),
        (changed(r"\d\.\d+ <rad>", "1e+30 <rad>"), "_ANGLE_NAME: expected AZIMUTH-MEASURED or"),
        (changed("<rad>", "<m>"), "ARTICULATION_DEVICE_ANGLE: expected radians or degrees, found 'm'"),
        (changed("= CAHVOR", "= PSPH"), "MODEL_TYPE: expected CAHV, CAHVOR or CAHVORE, found 'PSPH'"),
        (changed(r'"R"\)', '"S")'), "MODEL_COMPONENT_ID: expected C, A, H, V, O, R, found C, A, H, V, O, S"),
        (changed(r"(MODEL_COMPONENT_2 = \().*?,", r"\1"), "MODEL_COMPONENT_2: expected 3 numbers, found"),
        (
            changed(r"(MODEL_COMPONENT_2 = \().*?,", r"\1 1e+30,"),
            "MODEL_COMPONENT_2: expected a finite number",
        ),
        (
            changed(r"(MODEL_COMPONENT_2 = \().*?,", r'\1 "N/A",'),
            "MODEL_COMPONENT_2: expected a number, found 'N/A'",
        ),
        (changed(r"MODEL_COMPONENT_3 = \(.*?\)", "MODEL_COMPONENT_3 = (0, 0, 0)"), "focal length"),
        (
            changed(r"MODEL_COMPONENT_1 = \(.*?\)", "MODEL_COMPONENT_1 = (0, 1e9, 0)"),
            "camera centre: expected a point within 100 m of the rover, found",
        ),
        (
            changed("= ROVER_NAV_FRAME", "= LOCAL_LEVEL_FRAME"),
            "expected ROVER_FRAME or ROVER_NAV_FRAME or SITE_FRAME",
        ),
        (
            changed(r"QUATERNION = \(.*?\)", "QUATERNION = (0, 0, 0, 0)"),
            "ORIGIN_ROTATION_QUATERNION: a quaternion",
        ),
        (
            changed("= SITE_FRAME", "= ORBITAL"),
            "REFERENCE_COORD_SYSTEM_NAME: expected SITE_FRAME, found 'ORBITAL'",
        ),
        (changed("NAV_RIGHT_B", "MAHLI"), "INSTRUMENT_ID: expected a camera on the mast .* found 'MAHLI'"),
        (
            changed("HOST_ID = MSL", "HOST_ID = VL1"),
            "INSTRUMENT_HOST_ID: expected MER1, MER2, MSL or M20, found 'VL1'",
        ),
        (
            changed('"SITE", "DRIVE"', '"PLACE", "DRIVE"'),
            "ROVER_MOTION_COUNTER_NAME: expected SITE and DRIVE",
        ),
        (changed(r"\(4, 2100, ", "(2100, "), "ROVER_MOTION_COUNTER: expected 6 numbers, found 5"),
        (changed("ROVER_MOTION_COUNTER = ", "X = "), "ROVER_MOTION_COUNTER: expected an entry of the label"),
        (
            changed("LINES = 6", "LINES = 7"),
            "expected 8248 bytes or more .* found 8240: the file is truncated",
        ),
    ],
)
def test_bad_labels_are_named(tmp_path: Path, change: Callable[[str], str], message: str) -> None:
    write(tmp_path, "NRB_0", change(label_text(Shot(head=navcam_b_head(), joints=POINTINGS[0]), msl_mast())))
    with pytest.raises(InputError, match=f"NRB_0.IMG: .*{message}|NRB_0.IMG: {message}") as caught:
        read_pds(tmp_path)
    assert "\n" not in str(caught.value)


def test_cahvore_of_an_unknown_type_is_named(tmp_path: Path) -> None:
    shot = Shot(head=MARS2020_NAVCAM, joints=POINTINGS[0], instrument="NAVCAM_LEFT")
    text = label_text(shot, mars2020_mast(as_designed=True), host="M20")
    write(tmp_path, "NLF_0", text.replace("MODEL_COMPONENT_8 = 3.0", "MODEL_COMPONENT_8 = 4.0"))
    with pytest.raises(InputError, match="MODEL_COMPONENT_8: expected a CAHVORE type of 1, 2 or 3, found 4"):
        read_pds(tmp_path)


def test_folders_without_rover_images_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected images with PDS labels \(\*.IMG\), found none"):
        read_pds(tmp_path)
    with pytest.raises(InputError, match="expected a folder of rover images, found none"):
        read_pds(tmp_path / "nowhere")
    (tmp_path / "a.IMG").write_bytes(b"garbage" * 1000)
    with pytest.raises(InputError, match=r"a\.IMG: expected a PDS3 label"):
        read_pds(tmp_path)


def test_two_rovers_and_two_sites_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "NRB_0", label_text(Shot(head=navcam_b_head(), joints=POINTINGS[0]), msl_mast()))
    shot = Shot(head=MARS2020_NAVCAM, joints=POINTINGS[0], instrument="NAVCAM_LEFT")
    other = write(tmp_path, "ZLF_0", label_text(shot, mars2020_mast(as_designed=True), host="M20"))
    with pytest.raises(
        InputError, match=r"ZLF_0\.IMG: INSTRUMENT_HOST_ID: expected MSL as in NRB_0\.IMG, found M20"
    ):
        read_pds(tmp_path)
    other.unlink()
    write(
        tmp_path,
        "NRB_1",
        label_text(Shot(head=navcam_b_head(), joints=POINTINGS[0], counter=(5, 0, 1)), msl_mast()),
    )
    with pytest.raises(
        InputError, match=r"NRB_1\.IMG: ROVER_MOTION_COUNTER: expected site 4 as in NRB_0\.IMG"
    ):
        read_pds(tmp_path)


def test_truncated_opportunity_image_is_named(opportunity_folder: Path, tmp_path: Path) -> None:
    name = "1N491020376ILFCNY9P0706L0M1.IMG"
    (tmp_path / name).write_bytes((opportunity_folder / name).read_bytes()[:-1])
    said = rf"{name}: \^IMAGE: expected 2140160 bytes or more .* found 2140159"
    with pytest.raises(ImageError, match=said):
        read_pds(tmp_path)
    for other in sorted(opportunity_folder.glob("*.IMG"))[1:3]:
        (tmp_path / other.name).write_bytes(other.read_bytes())
    rest = read_pds(tmp_path)
    assert len(rest.images) == 2
    assert re.fullmatch(rf"image {Path(name).stem} is left out: .*{said}.*", rest.warnings[0])


def test_opportunity_label_without_camera_model_is_named(opportunity_folder: Path, tmp_path: Path) -> None:
    name = "1N491020376ILFCNY9P0706L0M1.IMG"
    data = (opportunity_folder / name).read_bytes()
    (tmp_path / name).write_bytes(data.replace(b"GEOMETRIC_CAMERA_MODEL", b"GEOMETRIC_CAMERA_OTHER"))
    with pytest.raises(InputError, match=f"{name}: expected a group GEOMETRIC_CAMERA_MODEL"):
        read_pds(tmp_path)


def test_the_quaternion_convention_of_labels_is_ours() -> None:
    # Scalar first, rotation of the frame in its reference: a label's quaternion is rover_R_head.
    rotation = rotation_from_wxyz((0.985667, -0.00392362, -0.0231492, -0.167063))
    np.testing.assert_allclose(wxyz_from_rotation(rotation)[0], 0.985667, atol=1e-6)
