"""Labels that are no labels of a rover but take a parser long: one sentence, in little time."""

import re
from pathlib import Path

import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.io import read_image, read_pds
from support.pds_files import pds_file
from support.rover_labels import POINTINGS, Shot, label_text, msl_mast, navcam_b_head

GOOD = label_text(Shot(head=navcam_b_head(), joints=POINTINGS[0]), msl_mast())
DIGITS = "9" * 400


def with_entry(entry: str) -> str:
    return GOOD.replace("MSL:ACTIVE", f"{entry}\r\nMSL:ACTIVE", 1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (with_entry(f"A = {'(' * 1000}1{')' * 1000}"), "found brackets nested too deeply"),
        (with_entry(f'A = "{"x" * 200_000}"'), "of at most 131072 characters, found 20"),
        (with_entry(f"A = ({'1,' * 100_000}1)"), "of at most 131072 characters, found 20"),
        (
            re.sub(r"LINES = 6", f"LINES = {DIGITS}", GOOD),
            r"LINES: expected an integer of 0 or above, found 9+\.\.\.$",
        ),
        (re.sub(r"\^IMAGE = 2", f"^IMAGE = {DIGITS}", GOOD), r"\^IMAGE: expected a record or a byte"),
        (re.sub(r"\^IMAGE = 2", "^IMAGE = ()", GOOD), "found an empty list"),
        (
            re.sub(r"QUATERNION = \(.*?,", f"QUATERNION = ({DIGITS},", GOOD, flags=re.S),
            "expected a finite number",
        ),
        (re.sub(r"COUNTER = \(4,", f"COUNTER = ({DIGITS},", GOOD), "COUNTER: expected a finite number"),
        (
            re.sub(r"LINES = 6", "LINES = 60000", GOOD).replace("LES = 8", "LES = 60000"),
            "at most 134217728 in all",
        ),
        (
            re.sub(r"HOST_ID = MSL", f"HOST_ID = 16#{'F' * 9000}#", GOOD),
            "HOST_ID: expected a text, found an integer",
        ),
    ],
)
def test_what_is_too_much_is_said(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "a.IMG").write_bytes(text.encode().ljust(8192) + bytes(48))
    with pytest.raises(InputError, match=said) as caught:
        read_pds(tmp_path)
    assert len(str(caught.value)) < 500 + len(str(tmp_path))


def test_long_lines_in_groups_that_are_not_used_do_no_harm(tmp_path: Path) -> None:
    group = f"GROUP = NOTES\r\n  A = {'x' * 200_000}\r\n  GROUP = a{' /*  */ ' * 20_000}x\r\nEND_GROUP = a"
    group += f"{' /*  */ ' * 20_000}x\r\nEND_GROUP = NOTES"
    text = with_entry(group).replace("RECORD_BYTES = 8192", "RECORD_BYTES = 1000000")
    (tmp_path / "a.IMG").write_bytes(text.encode().ljust(1_000_000) + bytes(48))
    assert len(read_pds(tmp_path).images) == 1


def test_constants_beyond_any_sample_match_none(tmp_path: Path) -> None:
    values = np.full((3, 4), 700, ">i2")
    extra = f"  MISSING_CONSTANT = {DIGITS}\r\n  INVALID_CONSTANT = (1e30, -1e999, 700)\r\n"
    image = read_image(pds_file(tmp_path / "a.IMG", values.tobytes(), extra=extra))
    np.testing.assert_array_equal(image, 0)


@pytest.mark.parametrize("kind", ["MSB_INTEGER", "INTEGER", "LSB_INTEGER", "UNSIGNED_INTEGER"])
def test_bytes_above_127_are_bright(tmp_path: Path, kind: str) -> None:
    values = np.arange(117, 129, dtype=np.uint8).reshape(3, 4) * 2 - 1
    np.testing.assert_array_equal(
        read_image(pds_file(tmp_path / "a.IMG", values.tobytes(), sample_type=kind, bits=8)), values
    )


def test_one_foreign_file_is_left_out_and_the_rest_read(tmp_path: Path) -> None:
    for name, text in (
        ("a", "no label"),
        ("b", GOOD),
        ("c", GOOD.replace("NAV_RIGHT_B", "MAHLI")),
        ("d", GOOD.replace("HOST_ID = MSL", "HOST_ID = VL1")),
        ("e", re.sub(r"GROUP = ROVER.*?END_GROUP = ROV\w*", "", GOOD, flags=re.DOTALL)),
    ):
        (tmp_path / f"{name}.IMG").write_bytes(text.encode().ljust(8192) + bytes(48))
    traverse = read_pds(tmp_path)
    assert [image.id for image in traverse.images] == ["b"]
    assert [warning.split(": ")[0] for warning in traverse.warnings] == [
        f"image {name} is left out" for name in "acde"
    ]
    assert all(f"{name}.IMG: " in warning for name, warning in zip("acde", traverse.warnings, strict=True))
