"""Image files: PDS sample types and layouts, ordinary formats, and everything that may be wrong."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pancam_graph.base.errors import ImageError
from pancam_graph.data import Traverse
from pancam_graph.io import read_image, same_pictures
from pancam_graph.io._pds_label import PdsLabel, read_label
from support import io_samples
from support.pds_files import pds_file

RAMP = np.arange(12).reshape(3, 4) * 300 - 600  # negative in places, above 8 bits in places


@pytest.mark.parametrize(
    ("sample_type", "dtype"),
    [
        ("MSB_INTEGER", ">i2"),
        ("MSB_UNSIGNED_INTEGER", ">u2"),
        ("UNSIGNED_INTEGER", ">u2"),
        ("LSB_INTEGER", "<i2"),
        ("PC_UNSIGNED_INTEGER", "<u2"),
        ("UNSIGNED_INTEGER", "u1"),
        ("INTEGER", "u1"),  # bytes are never below 0, whatever the label calls them
    ],
)
def test_samples_of_every_integer_type_are_read_and_negatives_become_zero(
    tmp_path: Path, sample_type: str, dtype: str
) -> None:
    kind = np.dtype(dtype)
    info = np.iinfo(kind)
    stored = np.clip(RAMP, info.min, info.max).astype(kind)
    file = pds_file(tmp_path / "a.IMG", stored.tobytes(), sample_type=sample_type, bits=8 * kind.itemsize)
    image = read_image(file)
    assert image.dtype == (np.uint8 if kind.itemsize == 1 else np.uint16)
    np.testing.assert_array_equal(image, np.maximum(stored, 0))


def test_a_pointer_may_count_bytes_and_lines_may_have_prefix_and_suffix(tmp_path: Path) -> None:
    values = np.maximum(RAMP, 0).astype(">u2")
    lines = b"".join(b"pp" + row.tobytes() + b"s" for row in values)
    extra = "  LINE_PREFIX_BYTES = 2\r\n  LINE_SUFFIX_BYTES = 1\r\n"
    file = pds_file(
        tmp_path / "a.img",
        lines,
        sample_type="MSB_UNSIGNED_INTEGER",
        extra=extra,
        pointer="1032 <BYTES>",
        padding=b"x" * 7,
    )
    np.testing.assert_array_equal(read_image(file), values)


@pytest.mark.parametrize("storage", ["BAND_SEQUENTIAL", "LINE_INTERLEAVED", "SAMPLE_INTERLEAVED"])
def test_colour_becomes_luma_in_every_storage(tmp_path: Path, storage: str) -> None:
    rgb = np.random.default_rng(1).integers(0, 255, (3, 4, 3), dtype=np.uint8)
    order = {"BAND_SEQUENTIAL": (2, 0, 1), "LINE_INTERLEAVED": (0, 2, 1), "SAMPLE_INTERLEAVED": (0, 1, 2)}
    file = pds_file(
        tmp_path / "a.IMG",
        rgb.transpose(order[storage]).tobytes(),
        sample_type="UNSIGNED_INTEGER",
        bits=8,
        extra=f"  BANDS = 3\r\n  BAND_STORAGE_TYPE = {storage}\r\n",
    )
    expected = np.rint(rgb.astype(float) @ [0.299, 0.587, 0.114])
    np.testing.assert_array_equal(read_image(file), expected)


def test_a_detached_label_points_to_its_image_whatever_the_case(tmp_path: Path) -> None:
    values = np.arange(12, dtype=np.uint8).reshape(3, 4)
    (tmp_path / "scene.IMG").write_bytes(b"h" * 512 + values.tobytes())
    attached = pds_file(
        tmp_path / "label.txt",
        b"",
        sample_type="UNSIGNED_INTEGER",
        bits=8,
        pointer='("SCENE.IMG", 2)',
    )
    attached.rename(tmp_path / "scene.LBL")
    np.testing.assert_array_equal(read_image(tmp_path / "scene.IMG"), values)


def test_a_detached_label_may_not_point_out_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "a.IMG").write_bytes(b"\0" * 24)
    pds_file(tmp_path / "x.txt", b"", pointer='("../a.IMG", 1)').rename(tmp_path / "a.LBL")
    with pytest.raises(ImageError, match=r"a\.LBL: \^IMAGE: expected a file beside the label"):
        read_image(tmp_path / "a.IMG")


def test_opportunity_image(opportunity_folder: Path) -> None:
    # The label states minimum, maximum and mean of its pixels.
    image = read_image(opportunity_folder / "1N491020376ILFCNY9P0706L0M1.IMG")
    assert image.shape == (1024, 1024)
    assert image.dtype == np.uint16
    assert (int(image.min()), int(image.max())) == (517, 4029)
    assert image.mean() == pytest.approx(1421.71, abs=5e-3)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_lossless_formats_come_back_bit_for_bit(tmp_path: Path, suffix: str, dtype: Any) -> None:
    image = np.random.default_rng(2).integers(0, np.iinfo(dtype).max, (20, 30)).astype(dtype)
    file = tmp_path / f"bild ü{suffix}"
    file.write_bytes(cv2.imencode(suffix, image)[1].tobytes())
    found = read_image(file)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, image)


def test_colour_and_alpha_of_ordinary_formats_become_grey(tmp_path: Path) -> None:
    bgra: NDArray[Any] = np.random.default_rng(3).integers(0, 65535, (8, 9, 4)).astype(np.uint16)
    file = tmp_path / "a.png"
    file.write_bytes(cv2.imencode(".png", bgra)[1].tobytes())
    found = read_image(file)
    assert found.dtype == np.uint16
    np.testing.assert_allclose(found, bgra[..., :3].astype(float) @ [0.114, 0.587, 0.299], atol=1.5)


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".pgm"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.98])
def test_truncated_files_are_refused(tmp_path: Path, suffix: str, share: float) -> None:
    data = cv2.imencode(suffix, np.random.default_rng(4).integers(0, 255, (60, 70), dtype=np.uint8))[1]
    file = tmp_path / f"a{suffix}"
    file.write_bytes(data.tobytes()[: int(share * len(data))])
    with pytest.raises(ImageError, match=f"a{suffix}: expected"):
        read_image(file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "a.IMG: expected a label that starts with .* found an empty file"),
        (b"LBLSIZE=2048 FORMAT='HALF'", "a.IMG: LBLSIZE: expected a label of 2048 bytes, found 26"),
        (
            b"PDS_VERSION_ID = PDS3\r\nRECORD_BYTES = 5",
            "a.IMG: expected a label that closes with the line END",
        ),
        (
            b"PDS_VERSION_ID = PDS3\r\n)(= = =\r\nEND\r\n",
            "a.IMG: expected entries of a PDS3 label, found text",
        ),
        # What pvl's lenient parser would loop on for ever:
        (
            b"PDS_VERSION_ID = PDS3\r\nX = (1.5 )=EL_5 = ( 6\r\nEND\r\n",
            "a.IMG: expected entries of a PDS3 label",
        ),
        (
            b"PDS_VERSION_ID = PDS3\r\nGROUP = R=A\r\nEND_GROUP = RA\r\nEND\r\n",
            "a.IMG: expected the end of group R=A, found END_GROUP = RA",
        ),
        (
            b"PDS_VERSION_ID = PDS3\r\nOBJECT = IMAGE /* pixels */\r\nEND\r\n",
            "a.IMG: expected the end of group IMAGE, found the end of the label",
        ),
        (
            b"PDS_VERSION_ID = PDS3\r\nEND_OBJECT = IMAGE\r\nEND\r\n",
            "a.IMG: expected the end of group none open, found END_OBJECT = IMAGE",
        ),
        (b"PDS_VERSION_ID = PDS3\r\nEND\r\n", "a.IMG: expected a group IMAGE, found none"),
        (
            b"PDS_VERSION_ID = PDS3\r\nOBJECT = IMAGE\r\nLINES = 1\r\nEND_OBJECT = IMAGE\r\nEND\r\n",
            r"a.IMG: \^IMAGE: expected an entry of the label, found none",
        ),
    ],
)
def test_files_without_a_usable_label_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    file = tmp_path / "a.IMG"
    file.write_bytes(content)
    with pytest.raises(ImageError, match=message):
        read_image(file)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sample_type": "VAX_REAL", "bits": 32}, "IMAGE: SAMPLE_TYPE.*found VAX_REAL of 32"),
        (
            {"size": (0, 4)},
            "IMAGE: LINES, LINE_SAMPLES, BANDS: expected 1 or more of each and at most .*, found 0, 4, 1",
        ),
        ({"size": (4, 4)}, "a.IMG: .IMAGE: expected 1056 bytes or more .* found 1048: the file is truncated"),
        ({"pointer": "0"}, "a.IMG: .IMAGE: expected a record or a byte"),
        ({"extra": "  BANDS = two\r\n"}, "IMAGE: BANDS: expected an integer"),
    ],
)
def test_wrong_image_entries_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    file = pds_file(tmp_path / "a.IMG", RAMP.astype(">i2").tobytes(), **changes)
    with pytest.raises(ImageError, match=message):
        read_image(file)


def test_missing_files_folders_and_floats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"none\.png: expected an image file, found nothing there"):
        read_image(tmp_path / "none.png")
    with pytest.raises(ImageError, match="expected an image file, found a folder"):
        read_image(tmp_path)
    file = tmp_path / "a.tif"
    file.write_bytes(cv2.imencode(".tif", np.ones((4, 4), dtype=np.float32))[1].tobytes())
    with pytest.raises(ImageError, match=r"a\.tif: expected samples of 8 or 16 bits, found float32"):
        read_image(file)


def test_opencv_stays_quiet_about_broken_files(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.tif"
    file.write_bytes(b"II*\0" + b"\0" * 30)
    with pytest.raises(ImageError):
        read_image(file)
    assert capfd.readouterr().err == ""


def pictured(folder: Path, *files: str) -> Traverse:
    """A traverse whose first images are of one eye and have these files."""
    sample = io_samples.traverse(folder=folder)
    images = [image for image in sample.images if image.camera == "pinhole"]
    named = tuple(replace(image, file=name) for image, name in zip(images, files, strict=False))
    return replace(sample, images=(*named, *images[len(named) :]), observations=None)


def grey(seed: int) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(0, 4000, (48, 64), dtype=np.uint16)


def save(path: Path, samples: NDArray[Any]) -> None:
    path.write_bytes(cv2.imencode(path.suffix, samples)[1].tobytes())


def test_pictures_are_the_same_by_their_samples_and_not_by_their_bytes(tmp_path: Path) -> None:
    save(tmp_path / "a.png", grey(1))
    save(tmp_path / "b.tif", grey(1))  # other bytes, the same samples
    save(tmp_path / "c.png", grey(2))
    save(tmp_path / "d.png", grey(1))
    traverse = pictured(tmp_path, "a.png", "b.tif", "c.png", "d.png")
    assert same_pictures(traverse) == {1: 0, 3: 0}
    save(tmp_path / "a.png", grey(3))  # a file that changes is looked at again
    assert same_pictures(traverse) == {3: 1}


def test_black_pictures_and_files_that_cannot_be_read_are_the_same_as_no_other(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        save(tmp_path / name, np.zeros((48, 64), np.uint8))
    for name in ("c.png", "d.png"):
        (tmp_path / name).write_bytes(b"nothing")
    assert same_pictures(pictured(tmp_path, "a.png", "b.png", "c.png", "d.png")) == {}


def test_the_label_of_a_file_is_parsed_once_for_as_long_as_it_is_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed: list[Path] = []

    def counted(file: Path) -> PdsLabel:
        parsed.append(file)
        return read_label(file)

    monkeypatch.setattr("pancam_graph.io._pds_samples.read_label", counted)
    file = pds_file(tmp_path / "a.IMG", np.maximum(RAMP, 0).astype(">i2").tobytes())
    for _ in range(3):
        np.testing.assert_array_equal(read_image(file), np.maximum(RAMP, 0))
    assert parsed == [file]
    pds_file(file, np.arange(8).astype(">i2").tobytes(), size=(2, 4))
    np.testing.assert_array_equal(read_image(file), np.arange(8).reshape(2, 4))
    assert parsed == [file, file]


def scene(seed: int) -> NDArray[np.uint8]:
    """Texture at several scales with shading, 64 x 48."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.normal(size=(48, 64)), (0, 0), s) * s for s in (0.7, 1.5, 4.0)]
    shaded = 110 + 30 * sum(layers) / np.std(sum(layers)) + np.linspace(-20, 20, 48)[:, None]
    return np.asarray(np.clip(np.rint(shaded), 1, 255), dtype=np.uint8)


@pytest.mark.parametrize("name", ["b.jpg", "b.webp", "b.tif"])
def test_a_picture_encoded_anew_and_taken_for_another_view_is_the_same(tmp_path: Path, name: str) -> None:
    save(tmp_path / "a.png", scene(1))
    copy = scene(1)
    save(tmp_path / name, copy.astype(np.uint16) * 16 if name == "b.tif" else copy)
    save(tmp_path / "c.png", scene(2))
    assert same_pictures(pictured(tmp_path, "a.png", name, "c.png")) == {1: 0}


@pytest.mark.parametrize("at_once", [1, 2, 512])
def test_copies_are_found_however_far_apart_they_are_in_a_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    monkeypatch.setattr("pancam_graph.io._looks._AT_ONCE", at_once)
    for name, seed in (("a.png", 1), ("b.png", 2), ("c.webp", 1), ("d.jpg", 1)):
        save(tmp_path / name, scene(seed))
    assert same_pictures(pictured(tmp_path, "a.png", "b.png", "c.webp", "d.jpg")) == {2: 0, 3: 0}


def test_two_exposures_of_one_pointing_are_two_pictures_and_their_copies_are_not(tmp_path: Path) -> None:
    noise = np.random.default_rng(3).normal(0, 1.5, (48, 64))
    save(tmp_path / "a.png", scene(1))
    save(tmp_path / "b.png", np.clip(scene(1) + noise, 1, 255).astype(np.uint8))
    traverse = pictured(tmp_path, "a.png", "b.png")
    first = traverse.frames[0]
    frames = tuple(replace(f, pan_rad=first.pan_rad, tilt_rad=first.tilt_rad) for f in traverse.frames)
    assert same_pictures(replace(traverse, frames=frames)) == {}
    assert same_pictures(traverse) == {1: 0}  # where telemetry has them look apart, one of them is misplaced
    save(tmp_path / "b.png", scene(1))
    assert same_pictures(replace(traverse, frames=frames)) == {1: 0}


def test_pictures_that_share_their_shading_or_their_missing_data_are_others(tmp_path: Path) -> None:
    for seed, name in enumerate(("a.png", "b.png", "c.png")):
        picture = scene(seed)
        picture[:, :20] = 0  # the same border without data
        save(tmp_path / name, picture)
    sky = np.linspace(60, 200, 48)[:, None] + np.random.default_rng(9).normal(0, 1, (2, 48, 64))
    for picture, name in zip(sky, ("d.png", "e.png"), strict=True):
        save(tmp_path / name, np.rint(picture).astype(np.uint8))
    assert same_pictures(pictured(tmp_path, "a.png", "b.png", "c.png", "d.png")) == {}
    assert same_pictures(pictured(tmp_path, "d.png", "e.png")) == {}
