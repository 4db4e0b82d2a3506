"""PDS labels: what is wrong in a label or a folder is named."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.io import read_pds
from support.rover_labels import (
    MARS2020_NAVCAM,
    POINTINGS,
    Shot,
    label_text,
    mars2020_mast,
    msl_mast,
    navcam_b_head,
    write,
)


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
            "ORIGIN_ROTATION_QUATERNION: expected a quaternion",
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
    with pytest.raises(InputError, match=r"expected rover images with labels \(.*\), found none$"):
        read_pds(tmp_path)
    with pytest.raises(InputError, match="expected a folder of rover images, found none"):
        read_pds(tmp_path / "nowhere")
    (tmp_path / "a.IMG").write_bytes(b"garbage" * 1000)
    with pytest.raises(InputError, match=r"a\.IMG: expected a label that starts with PDS_VERSION_ID"):
        read_pds(tmp_path)
