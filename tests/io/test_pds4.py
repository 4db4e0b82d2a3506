"""PDS4 labels of Perseverance to a traverse: the real label, and it with fields changed."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHVORE
from pancam_graph.io import read_image, read_input
from support.pds4_labels import REAL, once, pds4_text, real_text, sized, write_pds4
from support.rover_labels import FLIP, MARS2020_NAVCAM, POINTINGS, TOLERANCE, Shot, mars2020_mast

PIXELS = np.array([[10.0, 20.0], [640.0, 480.0], [1290.0, 970.0], [3.0, 960.0]])


def numbers(text: str, block: str, *names: str) -> FloatArray:
    """Numbers of the first block of a label, by a regular expression: apart from the package."""
    pose = block in {"Vector_Origin_Offset", "Quaternion_Plus_Direction"}
    start = text.index("<geom:Coordinate_Space_Definition>") if pose else 0
    body = re.search(rf"<geom:{block}>(.*?)</geom:{block}>", text[start:], re.DOTALL)
    assert body
    return np.array([float(re.search(rf"<geom:{name}[^>]*>([^<]*)", body[1])[1]) for name in names])  # type: ignore[index]  # absent: the test fails


def label_camera(text: str) -> CAHVORE:
    places, units, pixels = (
        tuple(f"{axis}_{what}" for axis in "xyz") for what in ("position", "unit", "pixel")
    )
    terms = ("c0", "c1", "c2")
    return CAHVORE(
        width_px=1296,
        height_px=976,
        C=numbers(text, "Vector_Center", *places),
        A=numbers(text, "Vector_Axis", *units),
        H=numbers(text, "Vector_Horizontal", *pixels),
        V=numbers(text, "Vector_Vertical", *pixels),
        O=numbers(text, "Vector_Optical", *units),
        R=numbers(text, "Radial_Terms", *terms),
        E=numbers(text, "Entrance_Terms", *terms),
        linearity=0.0,
    )


def test_the_real_label_projects_as_its_own_vectors_do(pds4_folder: Path, tmp_path: Path) -> None:
    text = real_text(pds4_folder)
    write_pds4(tmp_path, REAL, text, bytes(3 * 976 * 1296))
    traverse = read_input(tmp_path)
    assert traverse.warnings == ()
    assert [stop.id for stop in traverse.stops] == ["site30-drive1344"]
    assert [frame.id for frame in traverse.frames] == ["30-1344-2"]
    assert traverse.frames[0].pan_rad == pytest.approx(2 * np.pi - 3.12414 - 5.10068, abs=5e-3)
    assert traverse.rig.eyes[0].unit == "M20 NAVCAM_LEFT 103"
    (rotation,), (centre,) = traverse.camera_poses()
    camera = traverse.rig.eyes[0].camera
    rays = camera.unproject(PIXELS)
    w, x, y, z = numbers(text, "Quaternion_Plus_Direction", "qcos", "qsin1", "qsin2", "qsin3")
    site_R_rover = Rotation.from_quat([x, y, z, w]).as_matrix()
    offset = numbers(text, "Vector_Origin_Offset", "x_position", "y_position", "z_position")
    points = centre + (rays.origin_m + 20 * rays.direction) @ rotation.T
    in_rover = (points @ FLIP - offset) @ site_R_rover
    found, valid = label_camera(text).project(in_rover)
    assert valid.all()
    np.testing.assert_allclose(found, PIXELS, atol=1e-6)


def test_pointings_and_stops_follow_the_chain(pds4_folder: Path, tmp_path: Path) -> None:
    real, mast = real_text(pds4_folder), mars2020_mast(as_designed=False)
    right = replace(MARS2020_NAVCAM, C=MARS2020_NAVCAM.C + np.array([0.0, 0.424, 0.0]))
    for k, joints in enumerate(POINTINGS[:4]):
        for eye, head in (("LEFT", MARS2020_NAVCAM), ("RIGHT", right)):
            shot = Shot(
                head=head,
                joints=joints,
                instrument=f"NAVCAM_{eye}",
                counter=(30, 1344 if k < 2 else 1400, k),
                offset=(12.5, -3.25, -0.75) if k < 2 else (15.5, 0.75, -0.75),
            )
            name = f"N{eye[0]}F_{k}"
            text = pds4_text(real, name, shot, mast, clock=f"72278278{k}.631")
            write_pds4(tmp_path, name, text, bytes(48))
    traverse = read_input(tmp_path)
    assert traverse.warnings == ()
    assert [s.id for s in traverse.stops] == ["site30-drive1344", "site30-drive1400"]
    assert [e.name for e in traverse.rig.eyes] == ["navcam-left", "navcam-right"]
    assert len(traverse.frames) == 4
    rotations, centres = traverse.camera_poses()
    for image, rotation, centre in zip(traverse.images, rotations, centres, strict=True):
        text = (tmp_path / str(image.file)).with_suffix(".xml").read_text()
        c, a = (
            numbers(text, *names)
            for names in (
                ("Vector_Center", "x_position", "y_position", "z_position"),
                ("Vector_Axis", "x_unit", "y_unit", "z_unit"),
            )
        )
        w, x, y, z = numbers(text, "Quaternion_Plus_Direction", "qcos", "qsin1", "qsin2", "qsin3")
        offset = numbers(text, "Vector_Origin_Offset", "x_position", "y_position", "z_position")
        site_R_rover = Rotation.from_quat([x, y, z, w]).as_matrix()
        assert np.linalg.norm(centre - FLIP @ (site_R_rover @ c + offset)) < TOLERANCE
        assert np.linalg.norm(np.cross(rotation[:, 2], FLIP @ site_R_rover @ a)) < TOLERANCE


@pytest.mark.parametrize(
    ("kind", "dtype", "step"),
    [
        ("UnsignedByte", "u1", 1),
        ("UnsignedMSB2", ">u2", 80),
        ("UnsignedLSB2", "<u2", 80),
        ("SignedMSB2", ">i2", -80),
        ("SignedLSB2", "<i2", 80),
        ("IEEE754MSBSingle", ">f4", 1 / 47),
        ("IEEE754LSBDouble", "<f8", 1 / 47),
        ("UnsignedLSB4", "<u4", 100_000),
    ],
)
def test_samples_of_all_types_are_read(
    pds4_folder: Path, tmp_path: Path, kind: str, dtype: str, step: float
) -> None:
    values = np.arange(48) * step - 3 * abs(step) * ("i" in dtype)
    values[7] = 40
    text = sized(real_text(pds4_folder), 8, 6)
    text = once("(<data_type>)[^<]*", text, kind)
    text = once("(<missing_constant>)[^<]*", text, 40)
    if "f" in dtype:
        values[5:7] = np.nan, -3.4e38
    stored = values.astype(dtype)
    file = write_pds4(tmp_path, REAL, text, stored.tobytes())
    found = read_image(file).reshape(-1)
    expected = np.where((values > 0) & (values != 40), values, 0)
    scale = 65_000 / expected.max() if stored.itemsize > 2 else 1
    np.testing.assert_array_equal(found, np.rint(expected * scale))


def test_three_bands_in_any_order_of_axes_are_one_picture(pds4_folder: Path, tmp_path: Path) -> None:
    bands = np.random.default_rng(1).integers(1, 255, (3, 6, 8), dtype=np.uint8)
    text = sized(real_text(pds4_folder), 8, 6, 3)
    first = read_image(write_pds4(tmp_path, REAL, text, bands.tobytes()))
    weights = np.array([0.299, 0.587, 0.114])
    np.testing.assert_array_equal(first, np.rint(np.tensordot(weights, bands.astype(float), 1)))
    for order, axes in (((1, 0, 2), "213"), ((1, 2, 0), "312")):
        other = text
        for axis, number in zip(("Band", "Line", "Sample"), axes, strict=True):
            pattern = rf"(<axis_name>{axis}</axis_name>\s*<elements>\d+</elements>\s*<sequence_number>)\d"
            other = once(pattern, other, number)
        file = write_pds4(tmp_path, REAL, other, bands.transpose(order).tobytes())
        np.testing.assert_array_equal(read_image(file), first)


BOMB = '<!DOCTYPE a [<!ENTITY b "b"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]>'
OUTSIDE = '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/hostname">]>'


@pytest.mark.parametrize(
    ("pattern", "by", "said"),
    [
        ("(?=<Product_Observational )", BOMB, "found a document type, which labels do not have"),
        ("(?=<Product_Observational )", OUTSIDE, "found a document type, which labels do not have"),
        ("</geom:Geometry>", "", "expected an XML label, found text that is none (mismatched tag"),
        ("<title>", f"<title>{'<a>' * 80}", "found elements nested deeper than 64"),
        ("</title>", "&nothing;</title>", "found text that is none (undefined entity"),
        (r"Product_Observational", "Product_Browse", "expected a PDS4 label (Product_Observational), found"),
        ("<name>Mars 2020<", "<name>InSight<", "found 'INSIGHT', InSight, whose cameras are on an arm"),
        (
            "NAVCAM_LEFT",
            "FRONT_HAZCAM_LEFT_A",
            "found 'FRONT_HAZCAM_LEFT_A', a hazard camera, fixed to the body",
        ),
        ("NAVCAM_LEFT", "SHERLOC_WATSON", "found 'SHERLOC_WATSON', a camera on the arm"),
        ("Camera_Model_Parameters", "Nothing", "expected an element Camera_Model_Parameters, found none"),
        (">CAHVORE<", ">PSPH<", "expected model_type CAHV, CAHVOR or CAHVORE, found 'PSPH'"),
        ("type>2<", "type>7<", "expected a cahvore_model_type of 1, 2 or 3, found 7"),
        (r'(unit="m">)0\.955584', r"\1UNK", "x_position: expected a number, found 'UNK'"),
        (r'unit="m">0\.955584', 'unit="furlong">0.9', "x_position: expected the unit m, found 'furlong'"),
        ("AZIMUTH FINAL", "AZIMUTH", "expected AZIMUTH FINAL-RESOLVER or AZIMUTH-MEASURED or"),
        (">RSM</geom:device_id", ">MAST</geom:device_id", "expected the device RSM, found none"),
        (">SITE<", ">PLACE<", "Motion_Counter: expected SITE and DRIVE, found PLACE, DRIVE, POSE"),
        ("Forward", "Reverse", "expected rotation_direction Forward, found 'Reverse'"),
        (">ROVER_NAV_FRAME</geom:coord", ">LOCAL</geom:coord", "expected a Coordinate_Space_Definition of"),
        (r"(<geom:q\w+>)[^<]*", r"\g<1>0", "Quaternion_Plus_Direction: expected a quaternion"),
        ("UnsignedByte", "ComplexMSB8", "expected a data_type of UnsignedByte, SignedByte"),
        (">Band<", ">Time<", "expected axes Line and Sample"),
        ("<elements>976", "<elements>977", "bytes or more for 977 lines of 1296 samples"),
        ("<elements>976", f"<elements>{'9' * 12}", "expected 1 or more of each and at most 134217728 in all"),
        (r"NLF_0629[^<]*\.IMG", "../etc/x.IMG", "file_name: expected a file beside the label, found '../etc"),
        (r"NLF_0629[^<]*\.IMG", "other.IMG", "file_name: expected the image other.IMG beside the label"),
    ],
)
def test_what_is_wrong_with_a_label_is_said(
    pds4_folder: Path, tmp_path: Path, pattern: str, by: str, said: str
) -> None:
    real = real_text(pds4_folder)
    changed = re.sub(pattern, by, real)
    assert changed != real
    (tmp_path / "a.xml").write_text(changed)
    with (tmp_path / f"{REAL}.IMG").open("wb") as file:
        file.truncate(46656 + 3 * 976 * 1296)
    with pytest.raises(InputError) as caught:
        read_input(tmp_path)
    assert said in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)
