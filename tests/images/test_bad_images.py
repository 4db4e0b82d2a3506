"""Images that are wrong in some way: an error or a warning with the file's name, and the rest still found."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pancam_graph import Traverse, read_traverse, write_traverse
from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.images import find_observations
from pancam_graph.io import left_out, read_image, read_pds
from support.image_scenes import QUICK, SIZE_PX, as_bytes, found_in, make_traverse
from support.parameters import slow_but_for
from support.pds_files import pds_file
from support.pictures import read_picture

LAST = "s0-f2-left.png"


@pytest.fixture
def truth(tmp_path: Path) -> Traverse:
    """Three frames of one eye; the first two overlap each other, the last one the second."""
    return make_traverse(tmp_path, pans_deg=(-20.0, 0.0, 20.0), eyes=("left",))[0]


def seen(traverse: Traverse) -> set[int]:
    return set(found_in(traverse).image.tolist())


def without_last(truth: Traverse) -> bytes:
    last = replace(truth.images[-1], file=None)
    return as_bytes(found_in(find_observations(replace(truth, images=(*truth.images[:-1], last)), QUICK)))


def replaced(truth: Traverse, image: np.ndarray) -> Traverse:
    assert truth.folder is not None
    assert cv2.imwrite(str(truth.folder / LAST), image)
    return find_observations(truth, QUICK)


@pytest.mark.slow
def test_an_image_without_overlap_is_named_and_the_rest_found(truth: Traverse) -> None:
    away = replace(truth.frames[-1], pan_rad=np.pi)
    found = find_observations(replace(truth, frames=(*truth.frames[:-1], away)), QUICK)
    assert found.warnings == (
        f"image s0-f2-left ({LAST}): no observations were found in it "
        "(it overlaps no other image by pointing)",
    )
    assert seen(found) == {0, 1}


def test_images_none_of_which_overlap_are_named(truth: Traverse) -> None:
    frames = tuple(replace(f, pan_rad=2.0 * k) for k, f in enumerate(truth.frames))
    words = (
        r"found none \(0 pairs overlap by pointing\): s0-f0-left \(s0-f0-left\.png\) \(it overlaps no other"
    )
    with pytest.raises(InputError, match=words):
        find_observations(replace(truth, frames=frames), QUICK)


def test_an_image_of_all_sky_is_named_and_the_rest_found(tmp_path: Path) -> None:
    truth, _ = make_traverse(tmp_path, pans_deg=(-20.0, 0.0, 20.0), tilt_deg=30.0, eyes=("left",))
    rng = np.random.default_rng(1)
    sky = 150 + 0.05 * np.arange(SIZE_PX)[:, None] + rng.normal(scale=1.0, size=(SIZE_PX, SIZE_PX))
    found = replaced(truth, np.rint(sky).astype(np.uint8))
    assert any(
        w.startswith(f"image s0-f2-left ({LAST}): no observations") and w.endswith("% of it is sky)")
        for w in found.warnings
    )
    assert seen(found) == {0, 1}


@pytest.mark.slow
def test_an_over_exposed_image_is_named_and_the_rest_found(truth: Traverse) -> None:
    assert truth.folder is not None
    bright = read_picture(truth.folder / LAST).astype(float) * 1.8
    found = replaced(truth, np.clip(bright, 0, 255).astype(np.uint8))
    assert any(
        w.startswith(f"image s0-f2-left ({LAST}): over-exposed, ") and w.endswith("are saturated")
        for w in found.warnings
    )
    assert {0, 1} <= seen(found)
    white = replaced(truth, np.full((SIZE_PX, SIZE_PX), 255, np.uint8))
    assert f"image s0-f2-left ({LAST}): over-exposed, 100% of its pixels are saturated" in white.warnings
    assert seen(white) == {0, 1}


def spoil(file: Path, kind: str) -> str:
    """Spoil an image file; what is then said of it."""
    if kind == "missing":
        file.unlink()
        return "expected an image file, found nothing there"
    if kind == "truncated":
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        return rf"expected a whole PNG, found {len(whole) // 2} bytes without its end: truncated"
    cv2.imwrite(str(file), np.zeros((SIZE_PX, 2 * SIZE_PX), np.uint8))
    return "expected 240 x 240 pixels as of camera left of the rig small, found 480 x 240"


@pytest.mark.parametrize("kind", slow_but_for("truncated", ["missing", "truncated", "of another size"]))
def test_an_image_file_that_cannot_be_used_is_named_and_the_rest_found(truth: Traverse, kind: str) -> None:
    assert truth.folder is not None
    write_traverse(truth, truth.folder)
    rest = without_last(truth)
    said = f"image s0-f2-left is left out: {truth.folder / LAST}: {spoil(truth.folder / LAST, kind)}"
    for traverse in (read_traverse(truth.folder), truth):
        found = find_observations(traverse, QUICK)
        assert found.warnings == (said,)
        assert as_bytes(found_in(found)) == rest
    # With observations given, images are only for pictures.
    given = find_observations(truth, QUICK)
    write_traverse(replace(given, folder=None), truth.folder, overwrite=True)
    assert read_traverse(truth.folder).warnings == (said,)


@pytest.mark.parametrize("kind", slow_but_for("missing", ["missing", "truncated", "of another size"]))
def test_image_files_none_of_which_can_be_used_are_refused_by_name(truth: Traverse, kind: str) -> None:
    assert truth.folder is not None
    write_traverse(truth, truth.folder)
    given = find_observations(truth, QUICK)
    said = [spoil(truth.folder / str(image.file), kind) for image in truth.images]
    words = rf"s0-f0-left\.png: {said[0]}"
    with pytest.raises(ImageError, match=words):
        read_traverse(truth.folder)
    with pytest.raises(ImageError, match=words):
        find_observations(truth, QUICK)
    write_traverse(replace(given, folder=None), truth.folder, overwrite=True)
    if kind == "missing":
        assert len(read_traverse(truth.folder).warnings) == 3
    else:  # of the rig, or of the observations, one can doubt as well
        with pytest.raises(ImageError, match=words):
            read_traverse(truth.folder)


def test_of_many_image_files_a_few_are_named() -> None:
    errors = {f"i{k}": ImageError(f"{k}.png: expected an image file, found nothing there") for k in range(9)}
    assert left_out(errors)[4:] == [
        "image i4 is left out: 4.png: expected an image file, found nothing there",
        "4 more images are left out, whose files cannot be used either",
    ]
    assert len(left_out(dict(list(errors.items())[:5]))) == 5


@pytest.mark.slow
def test_colour_is_named_and_its_luma_used(truth: Traverse) -> None:
    assert truth.folder is not None
    grey = read_picture(truth.folder / LAST)
    plain = as_bytes(found_in(find_observations(truth, QUICK)))
    three = replaced(truth, np.dstack([grey] * 3))
    assert three.warnings == ()
    assert as_bytes(found_in(three)) == plain
    blue = np.dstack([grey, grey // 2, grey // 2])
    found = replaced(truth, blue)
    assert found.warnings == (f"images in colour, of which the luma is used: {LAST}",)
    assert seen(found) == {0, 1, 2}


def test_the_same_picture_twice_is_named_and_used_once(truth: Traverse) -> None:
    assert truth.folder is not None
    original = truth.folder / "s0-f0-left.png"
    encoded_anew = cv2.imencode(".jpg", read_picture(original))[1].tobytes()
    rest = without_last(truth)
    for copy in (original.read_bytes(), encoded_anew):
        (truth.folder / LAST).write_bytes(copy)
        found = find_observations(truth, QUICK)
        assert found.warnings[0] == (
            f"image s0-f2-left ({LAST}): the same picture as image s0-f0-left (s0-f0-left.png); left out"
        )
        assert as_bytes(found_in(found)) == rest


def test_one_file_for_two_images_is_the_same_picture(truth: Traverse) -> None:
    images = (*truth.images[:-1], replace(truth.images[-1], file="s0-f0-left.png"))
    found = find_observations(replace(truth, images=images), QUICK)
    assert "the same picture as image s0-f0-left (s0-f0-left.png); left out" in found.warnings[0]
    assert seen(found) == {0, 1}


def test_an_image_whose_mask_is_black_is_named(truth: Traverse) -> None:
    assert truth.folder is not None
    cv2.imwrite(str(truth.folder / "black.png"), np.zeros((SIZE_PX, SIZE_PX), np.uint8))
    images = (*truth.images[:-1], replace(truth.images[-1], mask="black.png"))
    found = find_observations(replace(truth, images=images), QUICK)
    expected = (
        f"image s0-f2-left ({LAST}): no observations were found in it (100% of it is black in its mask)"
    )
    assert expected in found.warnings
    assert seen(found) == {0, 1}


def test_two_rovers_in_a_traverse_are_refused_by_name(truth: Traverse) -> None:
    assert truth.folder is not None
    names = []
    for k, host in enumerate(("MER1", "MER1", "MER2")):
        grey = read_image(truth.folder / f"s0-f{k}-left.png")
        file = pds_file(
            truth.folder / f"{k}.IMG", grey.tobytes(), sample_type="UNSIGNED_INTEGER", bits=8, size=grey.shape
        )
        label = file.read_bytes()
        note = f"INSTRUMENT_HOST_ID = {host}\r\n".encode()
        file.write_bytes(
            label[:1024].rstrip(b" ").replace(b"NOTE", note + b"NOTE").ljust(1024) + label[1024:]
        )
        names.append(file.name)
    images = tuple(replace(i, file=n) for i, n in zip(truth.images, names, strict=True))
    write_traverse(replace(truth, images=images), truth.folder)
    words = r"2\.IMG: INSTRUMENT_HOST_ID: expected MER1 as in 0\.IMG, found MER2: images of two rovers"
    with pytest.raises(InputError, match=words):
        read_traverse(truth.folder)
    two = replace(truth, images=tuple(replace(i, file=n) for i, n in zip(images, names, strict=True)))
    write_traverse(
        replace(two, images=(*images[:2], replace(images[2], file=None))), truth.folder, overwrite=True
    )
    assert len(read_traverse(truth.folder).images) == 3


def test_of_two_rovers_in_a_folder_of_labels_one_is_used_and_the_other_named(
    opportunity_folder: Path, tmp_path: Path
) -> None:
    for k, file in enumerate(sorted(opportunity_folder.glob("*.IMG"))[:2]):
        host = rb'(INSTRUMENT_HOST_ID\s*=\s*"?)MER1'
        data = re.sub(host, rb"\g<1>MER2" if k else rb"\g<1>MER1", file.read_bytes())
        (tmp_path / file.name).write_bytes(data)
    traverse = read_pds(tmp_path)
    assert [image.id for image in traverse.images] == ["1N491020376ILFCNY9P0706L0M1"]
    (warning,) = traverse.warnings
    assert warning == (
        "1 image of MER2 left out, for a run is of one rover, MER1 with 1 image here: "
        "1N491020519ILFCNY9P0706L0M1.IMG"
    )


def test_what_a_label_calls_missing_is_missing(tmp_path: Path) -> None:
    values = np.full((30, 40), 700, ">i2")
    values[5:20, 5:20] = 32767
    values[22, 3] = -1
    extra = "  MISSING_CONSTANT = 32767\r\n  INVALID_CONSTANT = (-1, 5)\r\n"
    file = pds_file(tmp_path / "a.IMG", values.tobytes(), size=(30, 40), extra=extra)
    np.testing.assert_array_equal(read_image(file), np.where(values == 700, 700, 0))
