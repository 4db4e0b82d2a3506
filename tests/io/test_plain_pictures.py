"""Plain pictures with told pointing become the traverse that was meant, or are refused in a sentence."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pancam_graph import read_input, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.cli import main
from pancam_graph.data import UNKNOWN_RAD
from pancam_graph.io import read_image, rig_json
from pancam_graph.io.plain import (
    Exif,
    PlainOptions,
    PlainTraverse,
    plain_traverse,
    read_exif,
    write_plain,
)
from pancam_graph.rigs import Rig, rig_template, stereo_pan_tilt
from support.fuzzing import mutated_bytes
from support.plain_pictures import (
    FOCAL,
    FOCAL_35MM,
    HEIGHT,
    MAKE,
    MODEL,
    ORIENTATION,
    PLANE_UNIT,
    PLANE_X,
    SERIAL,
    WIDTH,
    Number,
    picture,
    pictures,
    small_tiff,
    table,
    tiff,
)

HEADER = "file,pan_deg,tilt_deg"
ROWS = ("a.png,-20,1", "b.png,0,2", "c.png,20,-3")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return pictures(tmp_path / "F", ["a.png", "b.png", "c.png"])


def made(folder: Path, *lines: str, **options: object) -> PlainTraverse:
    """The traverse by a table of these lines, of cameras with a focal length of 20 px."""
    pointing = table(folder / "p.csv", *(lines or (HEADER, *ROWS)))
    if not {"rig", "focal_px", "field_rad"} & set(options):
        options["focal_px"] = 20.0
    return plain_traverse(folder, PlainOptions(pointing=pointing, **options))  # type: ignore[arg-type]


def refused(folder: Path, *lines: str, **options: object) -> str:
    with pytest.raises(InputError) as error:
        made(folder, *lines, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def small_rig(*names: str) -> Rig:
    """The stereo unit with pictures of 16 x 12 px, its eyes renamed."""
    unit = stereo_pan_tilt(width_px=16, height_px=12)
    eyes = tuple(replace(eye, name=name) for eye, name in zip(unit.eyes, names, strict=True))
    return replace(unit, eyes=eyes)


# --- what is made ---


def test_what_is_written_is_what_refine_reads(folder: Path) -> None:
    plain = made(folder, arms_m=(0.1, 0.2, -0.05))
    write_plain(plain, folder)
    found = read_input(folder)
    assert [(i.id, i.file, i.camera) for i in found.images] == [
        (name, f"{name}.png", "camera") for name in "abc"
    ]
    np.testing.assert_allclose(
        found.pan_tilt_rad, np.deg2rad([[-20, 1], [0, 2], [20, -3]]), rtol=0, atol=1e-15
    )
    assert {s for f in found.frames for s in f.sigmas_rad} == {np.deg2rad(0.5)}
    assert found.stops[0].sigmas.tolist() == [0.0] * 6
    assert found.observations is None
    camera = found.rig.eyes[0].camera.pinhole
    assert (camera.width_px, camera.height_px, camera.fx_px, camera.cx_px, camera.cy_px) == (
        16,
        12,
        20.0,
        7.5,
        5.5,
    )
    # The camera at pan 0, tilt 0: its place, and that it looks forward with its columns to the right.
    rotation, place = found.rig.mast_T_camera(np.zeros((1, 2)), np.array([0]))
    np.testing.assert_allclose(place[0], [0.2, -0.05, 0.1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(rotation[0], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], rtol=0, atol=1e-12)
    assert found.rig.uncertainty == plain.traverse.rig.uncertainty
    text = (folder / "traverse.txt").read_text(encoding="utf-8")
    assert "focal length 20.0 px +- 2.0 %, as told by --focal-px" in text
    assert all(f"- {name}: {s:g}" in text for name, s in found.rig.uncertainty.sigmas.items())
    assert re.search(r"-20\.000 \(0\.5\) +1\.000 \(0\.5\)  stop  frame000  camera  a\.png", text)


def test_clockwise_pans_are_turned(folder: Path) -> None:
    stops = table(folder / "s.csv", "stop,x_m,y_m,z_m,yaw_deg", "stop,1,2,3,90")
    one, other = (made(folder, clockwise=c, stops=stops).traverse for c in (False, True))
    np.testing.assert_array_equal(other.pan_tilt_rad, one.pan_tilt_rad * [-1, 1])
    for traverse, sign in ((one, 1), (other, -1)):
        pose = traverse.stops[0].world_T_mast
        np.testing.assert_allclose(pose.rotation().matrix()[:, 0], [0, sign, 0], rtol=0, atol=1e-15)
        np.testing.assert_array_equal(pose.translation(), [1, 2, 3])


def test_sigmas_of_the_table_count_before_those_of_the_option(folder: Path) -> None:
    lines = (f"{HEADER},sigma_pan_deg,sigma_tilt_deg", "a.png,0,0,0.25,", "b.png,1,0,,0", "c.png,2,0,,")
    found = made(folder, *lines, sigma_rad=0.125).traverse.frames
    expected = [[np.deg2rad(0.25), 0.125], [0.125, 0.0], [0.125, 0.125]]
    np.testing.assert_array_equal([f.sigmas_rad for f in found], expected)


def test_a_template_and_rigs_in_files_are_taken_as_they_are(folder: Path, tmp_path: Path) -> None:
    rig = small_rig("left", "right")
    lines = (f"{HEADER},camera", "a.png,0,0,left", "b.png,0,0,right", "c.png,20,0,left")
    (tmp_path / "calibrated.json").write_bytes(rig_json(rig, name="x", passed=True))
    write_plain(
        made(folder, f"{HEADER},camera", "a.png,0,0,left", rig=str(tmp_path / "calibrated.json")), folder
    )
    entry = json.loads((folder / "traverse.json").read_text())["rig"]
    (tmp_path / "entry.json").write_text(json.dumps(entry))
    for file in (tmp_path / "calibrated.json", folder / "traverse.json", tmp_path / "entry.json"):
        found = made(folder, *lines, rig=str(file)).traverse
        assert [(i.frame, i.camera) for i in found.images] == [
            ("frame000", "left"), ("frame000", "right"), ("frame001", "left"),
        ]  # fmt: skip
        assert found.rig.uncertainty == rig.uncertainty
        for eye, other in zip(found.rig.eyes, rig.eyes, strict=True):
            np.testing.assert_allclose(
                eye.head_T_camera.matrix(), other.head_T_camera.matrix(), rtol=0, atol=1e-12
            )
    (folder / "m.pgm").write_bytes(b"P5 1024 1024 255\n")
    template = rig_template("mer-navcam")
    found = made(folder, f"{HEADER},camera", "m.pgm,0,0,right", rig="mer-navcam").traverse
    assert [e.name for e in found.rig.eyes] == [e.name for e in template.eyes]
    assert found.frames[0].sigma_pan_rad == template.pointing_sigma.pan_rad


def test_stops_are_subfolders_or_a_column(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "F", ["s1/a.png", "s1/b.png", "s2/a.png", "masks/a.png", ".x.png"])
    (folder / "out").mkdir()
    (folder / "out" / "solution.json").write_text("{}")
    pictures(folder / "out", ["mosaic.png"])
    stops = table(
        folder / "stops.csv",
        "stop,x_m,y_m,z_m,sigma_m,sigma_deg",
        "s1,0,0,0,,",
        "s2,5,0,-1,0.5,",
        "s3,1,1,1,,",
    )
    lines = (HEADER, "s1/a.png,0,0", "b.png,10,0", r"s2\a.png,0,0")
    found = made(folder, *lines, stops=stops).traverse
    assert [s.id for s in found.stops] == ["s1", "s2"]
    assert found.stops[0].sigmas.max() == 0
    np.testing.assert_allclose(found.stops[1].sigmas, np.repeat([np.deg2rad(2), 0.5], 3))
    assert [f.stop for f in found.frames] == ["s1", "s1", "s2"]
    assert [i.id for i in found.images] == ["s1_a", "s1_b", "s2_a"]
    assert [w.partition("stops.csv: ")[2] for w in found.warnings] == [
        "stop, line 4: no picture is of stop 's3'; left out"
    ]
    assert "expected --stops FILE.csv with the columns stop, x_m, y_m, z_m for the stops s1, s2" in refused(
        folder, *lines
    )
    alone = made(folder, f"{HEADER},stop", "s1/a.png,0,0,x", "s1/b.png,10,0,x", "s2/a.png,0,0,x").traverse
    assert [s.id for s in alone.stops] == ["x"]


def test_pictures_of_one_pointing_are_one_frame(folder: Path) -> None:
    named = f"{HEADER},camera,frame"
    together = made(folder, named, "a.png,0,0,l,", "b.png,0,0,r,", "c.png,0,0,l,").traverse
    assert [i.frame for i in together.images] == ["frame000", "frame000", "frame001"]
    told = made(folder, named, "a.png,0,0,l,x", "b.png,0,0,r,y", "c.png,1,0,r,z").traverse
    assert [i.frame for i in told.images] == ["x", "y", "z"]
    assert "frame, line 3: expected pan and tilt of frame 'x' as in line 2, found others" in refused(
        folder, named, "a.png,0,0,l,x", "b.png,1,0,r,x"
    )
    assert "expected one picture of camera 'l' in frame 'x', found another in line 2" in refused(
        folder, named, "a.png,0,0,l,x", "b.png,0,0,l,x"
    )


# --- cameras by EXIF ---

PHONE: dict[int, Number] = {MAKE: "Maker", MODEL: "Phone 7", FOCAL: (424, 100), FOCAL_35MM: 26}
SENSOR: dict[int, Number] = {
    MODEL: "D1",
    SERIAL: "77",
    FOCAL: (50, 1),
    PLANE_X: (32, 36),
    PLANE_UNIT: 4,
    WIDTH: 32,
    HEIGHT: 24,
}


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_exif_is_read_as_it_was_written(order: str, suffix: str) -> None:
    found = read_exif(picture(suffix, exif=tiff({**PHONE, **SENSOR, ORIENTATION: 6}, order)))
    assert found == Exif(
        make="Maker", model="D1", serial="77", orientation=6, focal_mm=50.0, focal_35mm=26.0,
        pixels_per_mm=32 / 36, size_px=(32, 24),
    )  # fmt: skip
    assert read_exif(picture(suffix)) == Exif()


def test_focal_lengths_by_exif(tmp_path: Path) -> None:
    phone = pictures(tmp_path / "P", ["a.jpg"], tiff(PHONE))
    found = made(phone, HEADER, "a.jpg,0,0", field_rad=None).traverse.rig
    assert found.eyes[0].camera.pinhole.fx_px == pytest.approx(
        26 * 20 / np.hypot(36, 24)
    )  # diagonal of 16 x 12
    assert 0.04 < found.uncertainty.focal < 0.05
    # A picture of 16 x 12 px that was resized from 32 x 24: half as many pixels on a millimetre.
    sensor = pictures(tmp_path / "S", ["a.jpg"], tiff(SENSOR))
    found = made(sensor, HEADER, "a.jpg,0,0", field_rad=None).traverse.rig
    assert found.eyes[0].camera.pinhole.fx_px == pytest.approx(50 * 32 / 36 / 2)
    assert found.uncertainty.focal == 0.03


def test_orientation_rolls_the_eye(tmp_path: Path) -> None:
    """Columns of an upright camera run right; of one whose pictures are turned clockwise to look, down."""
    down, up, left, right = [0, 0, -1], [0, 0, 1], [0, 1, 0], [0, -1, 0]
    for orientation, columns, rows in ((1, right, down), (6, down, left), (3, left, up), (8, up, right)):
        folder = pictures(tmp_path / str(orientation), ["a.jpg"], tiff({**PHONE, ORIENTATION: orientation}))
        rig = made(folder, HEADER, "a.jpg,0,0", field_rad=None).traverse.rig
        rotation, _ = rig.mast_T_camera(np.zeros((1, 2)), np.array([0]))
        np.testing.assert_allclose(rotation[0].T, [columns, rows, [1, 0, 0]], rtol=0, atol=1e-12)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_are_read_as_they_are_stored_whatever_the_file_says(orientation: int, tmp_path: Path) -> None:
    """Size and pointing go by the stored pixels: neither EXIF nor the tag of a TIFF turns what is read."""
    samples = np.random.default_rng(0).integers(0, 255, (3, 4), dtype=np.uint8)
    (tmp_path / "a.tif").write_bytes(small_tiff(orientation, samples))
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), samples)
    assert read_exif((tmp_path / "a.tif").read_bytes()).orientation == orientation
    for suffix in (".jpg", ".png"):
        (tmp_path / f"a{suffix}").write_bytes(picture(suffix))
        (tmp_path / f"b{suffix}").write_bytes(picture(suffix, exif=tiff({ORIENTATION: orientation})))
        np.testing.assert_array_equal(
            read_image(tmp_path / f"b{suffix}"), read_image(tmp_path / f"a{suffix}")
        )


def test_pictures_are_of_one_eye_by_size_camera_and_focal_length(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "F", ["a.jpg", "b.jpg"], tiff(PHONE))
    pictures(folder, ["c.jpg"], tiff({**PHONE, FOCAL_35MM: 52}))
    lines = ("a.jpg,0,0", "b.jpg,1,0", "c.jpg,2,0")
    found = made(folder, HEADER, *lines, field_rad=None).traverse
    assert [i.camera for i in found.images] == ["camera1", "camera1", "camera2"]
    focal = [eye.camera.pinhole.fx_px for eye in found.rig.eyes]
    assert focal[1] == pytest.approx(2 * focal[0])
    says = refused(folder, f"{HEADER},camera", *(f"{line},x" for line in lines), field_rad=None)
    assert "camera, line 4: expected pictures of 'x' by one camera at one focal length, found by EXIF" in says
    assert "in line 2: give them two names" in says


def test_two_cameras_with_one_serial_number_are_two_and_named(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "F", ["a.jpg"], tiff({**PHONE, SERIAL: "77"}))
    pictures(folder, ["b.jpg"], tiff({**PHONE, MODEL: "other", SERIAL: "77"}))
    pictures(folder, ["c.jpg"], tiff({**PHONE, FOCAL_35MM: 52, SERIAL: "77"}))  # another zoom of the first
    found = made(folder, HEADER, "a.jpg,0,0", "b.jpg,1,0", "c.jpg,2,0").traverse
    assert [i.camera for i in found.images] == ["camera1", "camera2", "camera3"]
    said = [warning for warning in found.warnings if "serial" in warning]
    assert said == [
        "EXIF of cameras camera1, camera2 says one serial number, 77, and different models; they are taken "
        "for cameras of their own"
    ]


def test_no_focal_length_is_a_sentence_that_names_the_options(folder: Path) -> None:
    assert refused(folder, field_rad=None) == (
        f"{folder}/a.png: expected EXIF that tells the focal length, found none; --focal-px or --field-deg "
        "tells it, or --rig a rig"
    )
    cases: tuple[tuple[dict[int, Number], str], ...] = (
        ({FOCAL: (424, 100)}, "found 4.24 mm on a sensor of unknown size"),
        (
            {FOCAL_35MM: 26, WIDTH: 30, HEIGHT: 12},
            "found that of a picture of 30 x 12 px, which was cropped to 16 x 12",
        ),
        ({FOCAL_35MM: 60000}, "found 60000 mm on 35-mm film"),
    )
    for exif, found in cases:
        (folder / "a.png").write_bytes(picture(".png", exif=tiff(exif)))
        assert found in refused(folder, HEADER, "a.png,0,0", field_rad=None)
    assert made(folder, field_rad=np.pi / 2).traverse.rig.eyes[0].camera.pinhole.fx_px == pytest.approx(8.0)


def test_nonsense_in_exif_is_a_warning(folder: Path) -> None:
    exif = tiff({**PHONE, FOCAL: (1, 0), ORIENTATION: 77})
    (folder / "a.png").write_bytes(picture(".png", exif=exif))
    found = made(folder, HEADER, "a.png,0,0").traverse
    assert found.warnings[0] == (
        "a.png: EXIF is not used where it is nonsense: Orientation is 77; FocalLength is inf"
    )


@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(st.integers(0, 2**32 - 1))
def test_no_exif_however_damaged_raises(seed: int) -> None:
    rng = np.random.default_rng(seed)
    good = tiff({**PHONE, **SENSOR, ORIENTATION: 6}, rng.choice(["<", ">"]))
    damaged = mutated_bytes(rng, good)
    for data in (
        damaged,
        b"\xff\xd8\xff\xe1" + b"\1\0Exif\0\0" + damaged,
        mutated_bytes(rng, picture(".jpg", exif=good)),
    ):
        found = read_exif(data)
        assert 1 <= found.orientation <= 8
        for number in (found.focal_mm, found.focal_35mm):
            assert number is None or 0 < number <= 1e6
        assert found.make.isprintable()


# --- what is refused ---


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["file,pan_deg", "a.png,0"], "p.csv: tilt_deg: expected one such column (of file, pan_deg, tilt_deg), found none"),  # noqa: E501  the whole sentence
        ([HEADER], "p.csv: expected a line for each picture or stop, found none"),
        (["file;pan_deg;tilt_deg", "a.png;0;0"], "line 1: expected commas between file, pan_deg, tilt_deg, found semicolons"),  # noqa: E501  the whole sentence
        (["", *ROWS], "p.csv: line 1: expected the column names file, pan_deg, tilt_deg, found an empty line"),  # noqa: E501  the whole sentence
        ([HEADER, "a.png,zero,1"], 'p.csv: pan_deg, line 2: expected a number, found "zero"'),
        ([HEADER, "a.png,0,"], 'p.csv: tilt_deg, line 2: expected a number, found ""'),
        ([HEADER, "a.png,nan,0"], 'pan_deg, line 2: expected a number from -3600 to 3600, found "nan"'),
        ([HEADER, "a.png,0,181"], 'tilt_deg, line 2: expected a number from -180 to 180, found "181"'),
        ([HEADER, "a.png,0"], "p.csv: row 0 (line 2): expected 3 cells, found 2"),
        ([HEADER, "a.png,0,0", "./a.png,1,0"], "p.csv: file, line 3: expected each file once, found 'a.png' in line 2 too"),  # noqa: E501  the whole sentence
        ([HEADER, ",0,0"], "p.csv: file, line 2: expected the name of a picture, found an empty cell"),
        ([HEADER, "x.png,0,0"], "p.csv: expected the pictures of the folder, found others; file, line 2:"),
        ([f"{HEADER},sigma_pan_deg", "a.png,0,0,-1"], "sigma_pan_deg, line 2: expected a number from 0 to 180"),  # noqa: E501  the whole sentence
        ([f"{HEADER},camera", "a.png,0,0,x", "b.png,0,0,"], "camera, line 3: expected the name of a camera"),
    ],
)  # fmt: skip
def test_a_table_that_is_wrong_is_one_sentence(lines: list[str], says: str, folder: Path) -> None:
    assert says in refused(folder, *lines)


def test_lines_without_pictures_and_pictures_without_lines_are_named(folder: Path) -> None:
    (folder / "notes.txt").write_text("x")
    (folder / "d.png").write_bytes(b"no picture")
    found = made(folder, f"{HEADER},sigma_pan", "a.png,0,0,1", "bb.png,1,0,1").traverse
    assert [i.id for i in found.images] == ["a"]
    told = " | ".join(found.warnings).replace(str(folder), "F")
    for says in (
        "d.png is left out: expected an image that can be read",
        "files that are no pictures are left alone: notes.txt",
        "F/p.csv: the column 'sigma_pan' is not used; is 'sigma_pan_deg' meant?",
        "F/p.csv: file, line 3: F has no picture 'bb.png'; is 'b.png' meant?; left out",
        "pictures without a line in F/p.csv are left out: b.png, c.png",
    ):
        assert says in told


def test_what_is_no_file_of_the_folder_is_named_and_never_opened(folder: Path, tmp_path: Path) -> None:
    os.mkfifo(folder / "pipe.png")
    (folder / "ring.png").symlink_to("ring.png")
    (folder / "gone.png").symlink_to("nothing.png")
    (tmp_path / "out.png").write_bytes(picture(".png"))
    (folder / "out.png").symlink_to(tmp_path / "out.png")
    (folder / "round").symlink_to(folder)
    found = made(folder).traverse
    assert [i.id for i in found.images] == ["a", "b", "c"]
    told = [w for w in found.warnings if " is left out: expected" in w and not w.startswith("round")]
    assert [w.partition(":")[0] for w in told] == [
        f"{name}.png is left out" for name in ("gone", "out", "pipe", "ring")
    ]
    assert "found a link that leads out of it" in told[1]
    assert "found a pipe" in told[2]


def test_pans_that_look_like_radians_are_doubted(tmp_path: Path) -> None:
    names = [f"{n}.png" for n in range(5)]
    folder = pictures(tmp_path / "F", names)
    radians = [f"{name},{1.2 * n},0" for n, name in enumerate(names)]
    (warning,) = made(folder, HEADER, *radians).traverse.warnings
    assert warning.endswith(
        "pans span 4.8 degrees, where a picture has 43.6; degrees are expected: are these radians?"
    )
    for lines, focal_px in (
        ([f"{name},{20 * n},0" for n, name in enumerate(names)], 20.0),
        (radians, 80.0),  # a narrow field of view, 11 degrees
        (radians[:3], 20.0),
    ):
        warnings = made(folder, HEADER, *lines, focal_px=focal_px).traverse.warnings
        assert not [w for w in warnings if "radians" in w]


def test_sizes_that_do_not_fit_are_named(folder: Path, tmp_path: Path) -> None:
    (folder / "b.png").write_bytes(picture(".png", 12, 16))
    (tmp_path / "rig.json").write_bytes(rig_json(small_rig("l", "r"), name="x", passed=True))
    rig = str(tmp_path / "rig.json")
    lines = (f"{HEADER},camera", "a.png,0,0,l", "b.png,1,0,l", "c.png,2,0,l")
    found = made(folder, *lines, rig=rig).traverse
    assert found.warnings == (
        "b.png: expected 16 x 12 pixels as of the rig stereo-pan-tilt, found 12 x 16, a picture that was "
        "turned; left out",
    )
    assert [i.id for i in found.images] == ["a", "c"]
    assert (
        "line 2: expected a column camera with one of l, r, as all of them have the size of a.png"
        in refused(folder, HEADER, *ROWS, rig=rig)
    )
    assert "camera, line 2: expected one of l, r; found 'm'" in refused(
        folder, lines[0], "a.png,0,0,m", rig=rig
    )
    own = made(folder, *lines).traverse
    assert own.warnings == (
        "camera l: expected pictures of one size, most often 16 x 12; of another are, and left out: b.png",
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"rig": "mer-navcan"}, "found 'mer-navcan'; is 'mer-navcam' meant?"),
        ({"rig": "mer-navcam", "focal_px": 3.0}, "expected --rig or --focal-px, found both"),
        ({"focal_px": 20.0, "field_rad": 1.0}, "expected --focal-px or --field-deg, found both"),
        ({"focal_px": 0.1}, "--focal-px: expected a focal length of 0.1 to 100 times the longer side of "),
        ({"focal_px": float("nan")}, "--focal-px: expected a focal length"),
        ({"field_rad": 4.0}, "--field-deg: expected a field of view between 0 and 180 degrees, found 229.183"),  # noqa: E501  the whole sentence
        ({"arms_m": (0.0, float("inf"), 0.0)}, "--arms: expected metres up to 100, found inf"),
        ({"arms_sigma_m": -1.0}, "--arms-sigma: expected 0 (exact) or a positive number, found -1"),
    ],
)  # fmt: skip
def test_an_option_that_makes_no_sense_is_one_sentence(
    options: dict[str, object], says: str, folder: Path
) -> None:
    assert says in refused(folder, **options)


def test_pointing_that_is_not_told_is_unknown_and_so_may_be_the_focal_length(folder: Path) -> None:
    for lines in ([], ["file", "a.png", "b.png", "c.png"], [HEADER, "a.png,,", "b.png,,", "c.png,,"]):
        pointing = table(folder / "p.csv", *lines) if lines else None
        found = plain_traverse(folder, PlainOptions(pointing=pointing)).traverse
        assert len(found.frames) == len(found.images) == 3
        assert all(frame.is_vague and min(frame.sigmas_rad) >= UNKNOWN_RAD for frame in found.frames)
        assert found.rig.eyes[0].camera.pinhole.fx_px == 16.0
        assert found.rig.uncertainty.focal == 0.5
    of_one_frame = made(folder, "file,camera,frame", "a.png,l,x", "b.png,r,x", "c.png,l,y").traverse
    assert [image.frame for image in of_one_frame.images] == ["x", "x", "y"]
    told = made(folder, sigma_rad=np.deg2rad(5))
    assert all(frame.is_vague for frame in told.traverse.frames)
    assert not any(frame.is_vague for frame in made(folder).traverse.frames)


def test_folders_that_are_none(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for path, says in (
        (tmp_path / "empty", "expected pictures (PNG, TIFF, JPEG,"),
        (tmp_path / "none", "expected a folder with pictures, found nothing there"),
        (folder / "a.png", "expected a folder with pictures, found a file"),
    ):
        with pytest.raises(InputError, match=re.escape(says)):
            plain_traverse(path, PlainOptions())
    with pytest.raises(
        InputError, match=r"found 3 pictures without; pancam-graph init .*F makes a traverse\.json"
    ):
        read_input(folder)


# --- the command ---


def test_the_command_writes_once_and_says_what_it_did(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pointing = table(folder / "p.csv", HEADER, *ROWS[:2])
    words = [
        "init",
        str(folder),
        "--pointing",
        str(pointing),
        "--field-deg",
        "60",
        "--arms",
        "0.1",
        "0.2",
        "-0.3",
    ]
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert (
        out.splitlines()[-1]
        == f"{folder}/traverse.json: 1 stop, 2 frames, 2 images; traverse.txt explains it"
    )
    assert err.splitlines()[-1] == f"warning: pictures without a line in {pointing} are left out: c.png"
    before = (folder / "traverse.json").read_bytes()
    assert main([*words, "--pan", "clockwise"]) == 2
    assert (
        "expected a folder without one, found one, which stays; --overwrite replaces it"
        in capsys.readouterr().err
    )
    assert (folder / "traverse.json").read_bytes() == before
    assert main([*words, "--pan", "clockwise", "--overwrite"]) == 0
    assert (folder / "traverse.json").read_bytes() != before
    config = folder / "options.toml"
    config.write_text(
        f'[init]\npointing = "{pointing}"\nfield-deg = 60\narms = [0.1, 0.2, -0.3]\noverwrite = true\n'
    )
    assert main(["init", str(folder), "--config", str(config)]) == 0
    assert (folder / "traverse.json").read_bytes() == before
    config.write_text("[init]\narms = [1, 2]\n")
    capsys.readouterr()
    assert main(["init", str(folder), "--config", str(config)]) == 2
    assert "[init] arms: expected a list of 3, found a list of 2" in capsys.readouterr().err


def test_a_traverse_that_was_made_is_copied_with_its_pictures(folder: Path, tmp_path: Path) -> None:
    write_traverse(made(folder).traverse, tmp_path / "copy")
    assert len(read_input(tmp_path / "copy").images) == 3
