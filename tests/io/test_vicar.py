"""VICAR labels: those that real images have behind their PDS3 labels say what these say."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.io import read_image, read_input
from pancam_graph.io._pds_image import read_labelled_image
from pancam_graph.io._pds_label import PdsLabel, read_label


def vicar_part(file: Path, to: Path) -> Path:
    """The file from its VICAR label on, which is a whole VICAR file."""
    data = file.read_bytes()
    to.write_bytes(data[data.index(b"LBLSIZE=") :])
    return to


@pytest.fixture(scope="module")
def opportunity(opportunity_folder: Path) -> Path:
    return opportunity_folder / "1N491020376ILFCNY9P0706L0M1.IMG"


def test_the_vicar_label_of_opportunity_says_what_its_pds_label_says(
    opportunity: Path, tmp_path: Path
) -> None:
    same_label(opportunity, vicar_part(opportunity, tmp_path / "a.VIC"))


def test_the_vicar_label_of_curiosity_says_what_its_pds_label_says(
    msl_label_folder: Path, tmp_path: Path
) -> None:
    (image,) = msl_label_folder.glob("*.IMG")
    same_label(image, vicar_part(image, tmp_path / "a.VIC"))


def same_label(pds: Path, vicar: Path) -> None:
    np.testing.assert_array_equal(read_image(vicar), read_image(pds))
    one, other = (read_labelled_image(file) for file in (pds, vicar))
    for letter in "CAHV":
        np.testing.assert_array_equal(getattr(other.model, letter), getattr(one.model, letter))
    np.testing.assert_array_equal(other.world_T_rover.matrix(), one.world_T_rover.matrix())
    for name in ("host", "instrument", "stop", "mast_counter", "clock_start", "pan_tilt_rad", "unit"):
        assert getattr(other, name) == getattr(one, name)
    assert type(read_label(vicar)) is PdsLabel


def test_a_label_that_goes_on_behind_the_samples_is_read(opportunity: Path, tmp_path: Path) -> None:
    data = vicar_part(opportunity, tmp_path / "a.VIC").read_bytes()
    size = 16384
    label, samples = data[:size].rstrip(b"\0"), data[size : size + 2 * 1024 * 1024]
    head, _, tail = label.partition(b"PROPERTY='PMA_COORDINATE_SYSTEM'")
    head = head.replace(b"EOL=0", b"EOL=1")
    end = b"LBLSIZE=16384  PROPERTY='PMA_COORDINATE_SYSTEM'" + tail
    expected = read_labelled_image(tmp_path / "a.VIC")
    (tmp_path / "b.VIC").write_bytes(head.ljust(size, b"\0") + samples + end.ljust(size, b"\0"))
    found = read_labelled_image(tmp_path / "b.VIC")
    assert found.pan_tilt_rad == expected.pan_tilt_rad
    assert replace(found, file=expected.file).instrument == expected.instrument


@pytest.mark.parametrize(
    ("pattern", "by", "said"),
    [
        (rb"LBLSIZE=16384", b"LBLSIZE=0    ", "LBLSIZE: expected 1 to 1048576 bytes, found 0"),
        (rb"FORMAT='HALF'", b"FORMAT='COMP'", "FORMAT: expected BYTE, HALF, FULL, REAL, DOUB, found 'COMP'"),
        (rb"COMPRESS='NONE'", b"COMPRESS='BASC'", "COMPRESS: expected NONE, found 'BASC'"),
        (rb"NL=1024", b"NL='no'", "NL: expected a whole number, found 'no'"),
        (rb"NLB=0", b"NLB=9", "the file is truncated"),
        (rb"\(195,973,5,25,59\)  ROVER", b"(195,973,5,25,59;  ROVER", "expected a list in brackets"),
        (rb"PROPERTY='GEOM", b"PROPERTY='NOTH", "expected a group GEOMETRIC_CAMERA_MODEL or"),
    ],
)
def test_what_is_wrong_with_a_label_is_said(
    opportunity: Path, tmp_path: Path, pattern: bytes, by: bytes, said: str
) -> None:
    file = vicar_part(opportunity, tmp_path / "a.VIC")
    changed, count = re.subn(pattern, by, file.read_bytes(), count=1)
    assert count
    file.write_bytes(changed)
    with pytest.raises(InputError) as caught:
        read_input(tmp_path)
    assert said in str(caught.value)
    assert "a.VIC" in str(caught.value)
