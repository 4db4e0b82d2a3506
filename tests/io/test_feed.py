"""The raw-image feed to a traverse: a real record with its fields changed, alone and in a response."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.cameras import CAHV, CAHVORE
from pancam_graph.io import read_input
from pancam_graph.rigs import MARS2020_MAST
from support.rover_labels import FLIP, MARS2020_NAVCAM, POINTINGS, TOLERANCE, mars2020_mast, turned

REAL = "NLF_0670_0726421423_362ECM_N0320604NCAM08111_01_095J01"
WXYZ = (0.98, 0.02, -0.03, 0.195)


@pytest.fixture(scope="module")
def real(feed_folder: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((feed_folder / f"{REAL}-metadata.json").read_text())
    return record


def record_of(
    real: dict[str, Any], k: int, head: CAHV = MARS2020_NAVCAM, eye: str = "LEFT", drive: int = 604
) -> dict[str, Any]:
    """The real record with camera, angles, clock, counters and place of another image."""
    joints = POINTINGS[k]
    rotation, point = mars2020_mast(as_designed=True).head(*joints)
    model = turned(head, rotation, point)
    assert isinstance(model, CAHVORE)
    vectors = [f"({','.join(repr(float(v)) for v in getattr(model, letter))})" for letter in "CAHVORE"]
    pan, tilt = MARS2020_MAST.pan_tilt_rad(*joints)
    name = f"N{eye[0]}F_0670_07264214{k:02d}_362ECM_N0320604NCAM08111_01_095J"
    return real | {
        "instrument": f"NAVCAM_{eye}",
        "imageid": name,
        "link": f"https://mars.nasa.gov/ncam/{name}01.png",
        "camera_model_component_list": ";".join([*vectors, "3", str(model.linearity)]),
        "mast_az": -np.rad2deg(pan) + 0.8,
        "mast_el": np.rad2deg(tilt) - 0.6,
        "drive": drive,
        "xyz": "(12.5,-3.25,-0.75)" if drive == 604 else [15.5, 0.75, -0.75],
        "attitude": str(WXYZ),
        "dimension": "(8,6)",
    }


def picture(folder: Path, record: dict[str, Any]) -> None:
    name = str(record["link"]).rpartition("/")[2]
    cv2.imwrite(str(folder / name), np.full((6, 8, 3), 90, np.uint8))


def nested(record: dict[str, Any]) -> dict[str, Any]:
    """A record as the service of Perseverance nests it: its numbers are texts."""
    keys = (
        "instrument",
        "camera_model_component_list",
        "camera_model_type",
        "camera_position",
        "filter_name",
    )
    extended = {"mastAz": str(record["mast_az"]), "mastEl": str(record["mast_el"]), "xyz": str(record["xyz"])}
    extended |= {"subframeRect": "(1,1,8,6)", "dimension": record["dimension"], "scaleFactor": "1"}
    return {
        "extended": extended,
        "camera": {key: record[key] for key in keys},
        "imageid": record["imageid"],
        "image_files": {"full_res": record["link"]},
        "attitude": record["attitude"],
        "site": str(record["site"]),
        "drive": str(record["drive"]),
    }


def components(record: dict[str, Any]) -> list[FloatArray]:
    parts = str(record["camera_model_component_list"]).split(";")[:7]
    return [np.array([float(v) for v in part.strip("()").split(",")]) for part in parts]


def test_the_real_record_projects_as_its_own_vectors_do(feed_folder: Path, real: dict[str, Any]) -> None:
    traverse = read_input(feed_folder)
    assert [stop.id for stop in traverse.stops] == ["site32-drive604"]
    assert any("mast_az and mast_el are not used" in warning for warning in traverse.warnings)
    assert any("site32-drive604: the labels have no attitude" in warning for warning in traverse.warnings)
    frame = traverse.frames[0]
    # The record's angles are of another axis than the head's, up to 1.3 degrees off it.
    assert np.rad2deg(frame.pan_rad) == pytest.approx(-float(real["mast_az"]), abs=1.5)
    assert np.rad2deg(frame.tilt_rad) == pytest.approx(float(real["mast_el"]), abs=1.0)
    (rotation,), (centre,) = traverse.camera_poses()
    C, A, H, V, O, R, E = components(real)  # noqa: E741  the literature's names
    own = CAHVORE(width_px=1288, height_px=968, C=C, A=A, H=H, V=V, O=O, R=R, E=E, linearity=0.0)
    pixels = np.array([[5.0, 4.0], [640.0, 480.0], [1280.0, 960.0], [2.0, 950.0]])
    rays = traverse.rig.eyes[0].camera.unproject(pixels)
    points = centre + (rays.origin_m + 20 * rays.direction) @ rotation.T
    found, valid = own.project(points @ FLIP - [12.8213, 60.1509, 0.32331])
    assert valid.all()
    np.testing.assert_allclose(found, pixels, atol=1e-6)


@pytest.mark.parametrize("response", [False, True])
def test_records_of_two_eyes_and_two_stops(real: dict[str, Any], tmp_path: Path, response: bool) -> None:
    right = replace(MARS2020_NAVCAM, C=MARS2020_NAVCAM.C + np.array([0.0, 0.424, 0.0]))
    records = [
        record_of(real, k, head, eye, 604 if k < 2 else 700)
        for k in range(3)
        for eye, head in (("LEFT", MARS2020_NAVCAM), ("RIGHT", right))
    ]
    for record in records:
        picture(tmp_path, record)
        if not response:
            (tmp_path / f"{record['imageid']}.json").write_text(json.dumps(record))
    if response:
        absent = nested(record_of(real, 5))
        (tmp_path / "a.json").write_text(json.dumps({"images": [*map(nested, records), absent]}))
    traverse = read_input(tmp_path)
    said = [w for w in traverse.warnings if "not used" not in w]
    assert said == (["a.json: 1 of its 7 records have no picture here"] if response else [])
    assert [s.id for s in traverse.stops] == ["site32-drive604", "site32-drive700"]
    assert [e.name for e in traverse.rig.eyes] == ["navcam-left", "navcam-right"]
    assert len(traverse.frames) == 3
    rotations, centres = traverse.camera_poses()
    w, x, y, z = np.array(WXYZ) / np.linalg.norm(WXYZ)
    site_R_rover = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    by_name = {str(record["imageid"]): record for record in records}
    for image, rotation, centre in zip(traverse.images, rotations, centres, strict=True):
        record = by_name[image.id.removesuffix("01")]
        c, a, *_ = components(record)
        xyz = np.array(json.loads(str(record["xyz"]).replace("(", "[").replace(")", "]")))
        assert np.linalg.norm(centre - FLIP @ (site_R_rover @ c + xyz)) < TOLERANCE
        assert np.linalg.norm(np.cross(rotation[:, 2], FLIP @ site_R_rover @ a)) < TOLERANCE


@pytest.mark.parametrize(
    ("entry", "value", "said"),
    [
        ("mast_az", "nonsense", 'mast_az: expected a number, found "nonsense"'),
        ("site", "UNK", "site, drive: expected two whole numbers, found '', '604'"),
        ("drive", 3.5, "site, drive: expected two whole numbers"),
        ("xyz", None, "xyz: expected the rover's place in its site, three numbers, found none"),
        ("xyz", "(1,2)", 'xyz: expected 3 numbers, found "(1,2)"'),
        ("xyz", [1, 2, True], "xyz: expected 3 numbers, found a list of 3"),
        ("attitude", "(0,0,0,0)", "a quaternion"),
        ("dimension", "(8,7)", "expected 8 x 7 pixels as of"),
        ("instrument", "FRONT_HAZCAM_LEFT_A", "'FRONT_HAZCAM_LEFT_A', a hazard camera, fixed to the body"),
        ("instrument", "IDC", "'INSIGHT', InSight, whose cameras are on an arm"),
        ("instrument", "SUPERCAM_RMI", None),
        ("camera_model_component_list", "UNK", "expected the vectors C;A;H;V;O;R;E, each of three numbers"),
        ("camera_model_component_list", "(1,2,3);(nan,0,0)", "expected the vectors C;A;H;V;O;R;E, each"),
        ("camera_model_component_list", 7, "expected the vectors C;A;H;V;O;R;E, each"),
        ("camera_model_type", "PSPH", 'camera_model_type: expected CAHV, CAHVOR or CAHVORE, found "PSPH"'),
    ],
)
def test_what_is_wrong_with_a_record_is_said(
    real: dict[str, Any], tmp_path: Path, entry: str, value: object, said: str | None
) -> None:
    record = record_of(real, 0)
    picture(tmp_path, record)
    (tmp_path / "a.json").write_text(json.dumps(record | {entry: value}))
    if said is None:
        traverse = read_input(tmp_path)
        assert any("pointing by mast_az and mast_el" in warning for warning in traverse.warnings)
        assert traverse.frames[0].sigma_pan_rad == pytest.approx(np.deg2rad(1.0))
        return
    with pytest.raises(InputError) as caught:
        read_input(tmp_path)
    assert said in str(caught.value)
    assert "a.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_attitude_angles_and_counts_as_text_are_read(real: dict[str, Any], tmp_path: Path) -> None:
    record = record_of(real, 0) | {"attitude": "UNK", "mast_az": "UNK", "mast_el": None, "site": "32"}
    picture(tmp_path, record)
    (tmp_path / "a.json").write_text(json.dumps([record]))
    traverse = read_input(tmp_path)
    assert traverse.stops[0].id == "site32-drive604"
    assert any("no attitude" in warning for warning in traverse.warnings)


def test_a_record_without_its_picture_and_foreign_json_are_told_apart(
    real: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "other.json").write_text('{"a": [1, 2]}')
    with pytest.raises(InputError, match=r"expected rover images with labels .*, found none$"):
        read_input(tmp_path)
    (tmp_path / "a.json").write_text(json.dumps(record_of(real, 0)))
    with pytest.raises(
        InputError, match=r"a\.json: expected a picture of a record beside it, found none for 1"
    ):
        read_input(tmp_path)
    (tmp_path / "a.json").write_text('{"a": ')
    with pytest.raises(InputError, match=r"a\.json: line 1, column 7: expected JSON, found an error"):
        read_input(tmp_path)


def test_an_attitude_that_is_missing_comes_from_the_stop_or_leaves_it_out(
    real: dict[str, Any], tmp_path: Path
) -> None:
    absent = {"attitude": None}
    records = [
        record_of(real, 0),
        record_of(real, 1) | absent,
        record_of(real, 2, drive=700) | absent,
    ]
    for record in records:
        picture(tmp_path, record)
    (tmp_path / "a.json").write_text(json.dumps(records))
    traverse = read_input(tmp_path)
    assert [stop.id for stop in traverse.stops] == ["site32-drive604"]
    assert len(traverse.images) == 2
    name = str(records[2]["link"]).rpartition("/")[2]
    assert (
        "1 image left out, for no label of their stop has the rover's place and attitude: " + name
    ) in traverse.warnings
    assert not any("no attitude" in warning for warning in traverse.warnings)
    # Without any attitude the stops are apart: the one with most images is solved.
    (tmp_path / "a.json").write_text(json.dumps([record | absent for record in records]))
    alone = read_input(tmp_path)
    assert len(alone.images) == 2
    assert any(
        warning.startswith("1 image of site and drive (32, 700) left out") for warning in alone.warnings
    )
