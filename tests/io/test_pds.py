"""PDS labels to a traverse: kinematics against published numbers, and labels made in support/rover_labels."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.geometry import FloatArray, pan_tilt_rotation, rotation_from_wxyz, wxyz_from_rotation
from pancam_graph.cameras import CAHV, CAHVORE
from pancam_graph.io import read_pds
from pancam_graph.io._pds import LOCALISATION_SIGMA
from pancam_graph.rigs import MARS2020_MAST, MSL_MAST, MastKinematics
from support.rover_labels import (
    FLIP,
    MARS2020_NAVCAM,
    NAVCAM_B,
    NAVCAM_B_JOINTS,
    POINTINGS,
    TOLERANCE,
    Shot,
    label_text,
    mars2020_mast,
    misfits,
    msl_mast,
    navcam_b_head,
    numbers,
    turned,
    write,
)

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


def test_other_zooms_and_principal_points_are_other_eyes(tmp_path: Path) -> None:
    head, mast = navcam_b_head(), msl_mast()
    variants = [
        head,
        replace(head, H=head.H + 100 * head.A),
        replace(head, H=2 * head.H, V=2 * head.V),
    ]
    for k, model in enumerate(variants):
        shot = Shot(head=model, joints=POINTINGS[0], counter=(4, 2100, 7))
        write(tmp_path, f"NRB_{k}", label_text(shot, mast), model)
    linear = CAHV(width_px=8, height_px=6, C=head.C, A=head.A, H=head.H, V=head.V)
    write(tmp_path, "NRB_3", label_text(Shot(head=linear, joints=POINTINGS[0]), mast))
    traverse = read_pds(tmp_path)
    names = ["nav-right-b", *(f"nav-right-b-{k}" for k in range(2, 5))]
    assert [i.camera for i in traverse.images] == names
    assert len(traverse.frames) == 1
    assert type(traverse.rig.eyes[3].camera) is CAHV
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


def test_the_quaternion_convention_of_labels_is_ours() -> None:
    # Scalar first, rotation of the frame in its reference: a label's quaternion is rover_R_head.
    rotation = rotation_from_wxyz((0.985667, -0.00392362, -0.0231492, -0.167063))
    np.testing.assert_allclose(wxyz_from_rotation(rotation)[0], 0.985667, atol=1e-6)
