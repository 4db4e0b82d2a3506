"""Folders with images of several rovers and sites and with other files: what is used, and what is said."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray, rotation_from_wxyz
from pancam_graph.io import read_input
from support.rover_labels import (
    FLIP,
    MARS2020_NAVCAM,
    POINTINGS,
    Shot,
    label_poses,
    label_text,
    mars2020_mast,
    msl_mast,
    navcam_b_head,
    write,
)

TURN = (0.9987502603949663, 0.0, 0.0, 0.04997916927067833)
"""0.1 radians about down."""
SITE = """GROUP = SITE_COORD_SYSTEM_PARMS\r
  COORDINATE_SYSTEM_INDEX = {site}\r
  ORIGIN_OFFSET_VECTOR = (20.0, -5.0, 1.0)\r
  ORIGIN_ROTATION_QUATERNION = {turn}\r
  REFERENCE_COORD_SYSTEM_NAME = SITE_FRAME\r
  REFERENCE_COORD_SYSTEM_INDEX = {before}\r
END_GROUP = SITE_COORD_SYSTEM_PARMS\r
OBJECT = IMAGE"""


def shot(folder: Path, name: str, site: int, k: int, placed: bool = False) -> str:
    """An image of Curiosity at a site, whose label may say where the site is in the one before."""
    text = label_text(Shot(head=navcam_b_head(), joints=POINTINGS[k], counter=(site, 2100, k)), msl_mast())
    if placed:
        text = text.replace("OBJECT = IMAGE", SITE.format(site=site, before=site - 1, turn=TURN), 1)
    write(folder, name, text)
    return text


def perseverance(folder: Path, name: str) -> None:
    seen = Shot(head=MARS2020_NAVCAM, joints=POINTINGS[0], instrument="NAVCAM_LEFT")
    write(folder, name, label_text(seen, mars2020_mast(as_designed=True), host="M20"))


def test_the_rover_with_most_images_is_used_and_all_else_named(tmp_path: Path) -> None:
    for k in range(2):
        shot(tmp_path, f"NRB_{k}", 4, k)
    perseverance(tmp_path, "ANF_0")
    (tmp_path / "notes.txt").write_text("dust devil at noon")
    (tmp_path / "thumb.png").write_bytes(b"no picture")
    (tmp_path / "tracks.xml").write_text("<vector/>")
    (tmp_path / "1664MR.LBL").write_text("PDS_VERSION_ID = PDS3\r\nEND\r\n")
    traverse = read_input(tmp_path)
    assert [image.id for image in traverse.images] == ["NRB_0", "NRB_1"]
    said = "\n".join(traverse.warnings)
    for sentence in (
        "1664MR.LBL: expected its image 1664MR.IMG beside it, found none",
        "1 image of M20 left out, for a run is of one rover, MSL with 2 images here: ANF_0.IMG",
        "not read, for they are no labels and no labelled pictures: notes.txt, thumb.png, tracks.xml",
    ):
        assert sentence in said


def test_sites_are_placed_by_labels(tmp_path: Path) -> None:
    texts = [shot(tmp_path, f"NRB_{k}", 4 + (k > 1), k, placed=k > 1) for k in range(4)]
    traverse = read_input(tmp_path)
    assert traverse.warnings == ()
    assert [stop.id for stop in traverse.stops] == ["site4-drive2100", "site5-drive2100"]
    check_places(traverse.camera_poses()[1], texts)


def test_sites_are_placed_by_a_file_of_sites(tmp_path: Path) -> None:
    texts = [shot(tmp_path, f"NRB_{k}", 4 + (k > 1), k) for k in range(4)]
    alone = read_input(tmp_path)
    assert [stop.id for stop in alone.stops] == ["site4-drive2100"]
    assert alone.warnings == (
        "2 images of site 5 and what is placed by it left out, for nothing says where it is from site 4, "
        "which has 2 images: NRB_2.IMG, NRB_3.IMG",
    )
    s, *v = TURN
    frames = 'name="SITE_FRAME" index1="5"><reference_frame name="SITE_FRAME" index1="4"/>'
    turn = f'<orientation s="{s}" v1="{v[0]}" v2="{v[1]}" v3="{v[2]}"/></solution>'
    (tmp_path / "a.svf").write_text(
        '<rmc_file><priority><entry solution_id="telemetry"/><entry solution_id="b"/></priority>'
        f'<solution solution_id="b" {frames}<offset x="20.0" y="-5.0" z="1.0"/>{turn}'
        f'<solution solution_id="telemetry" {frames}<offset x="1" y="2" z="3"/>{turn}</rmc_file>'
    )
    traverse = read_input(tmp_path)
    assert traverse.warnings == ()
    check_places(traverse.camera_poses()[1], texts)
    (tmp_path / "a.svf").write_text('<rmc_file><solution index1="x"><reference_frame/></solution></rmc_file>')
    said = "\n".join(read_input(tmp_path).warnings)
    assert "a.svf: solution: expected a whole number index1, found 'x'" in said


def check_places(centres: FloatArray, texts: list[str]) -> None:
    turn, offset = rotation_from_wxyz(TURN), np.array([20.0, -5.0, 1.0])
    for k, (centre, text) in enumerate(zip(centres, texts, strict=True)):
        in_site = FLIP @ label_poses(text)[0]
        expected = in_site if k < 2 else turn @ in_site + offset
        np.testing.assert_allclose(centre, FLIP @ expected, atol=1e-5)


def test_navcam_and_mastcam_share_one_head(tmp_path: Path) -> None:
    head = navcam_b_head()
    mastcam = replace(
        head, C=head.C + np.array([-0.15, -0.3, 0.0]), H=3 * head.H - head.A, V=3 * head.V - head.A
    )
    for k in range(3):
        for name, model in (("NAV_RIGHT_B", head), ("MAST_LEFT", mastcam)):
            seen = Shot(head=model, joints=POINTINGS[k], instrument=name, counter=(4, 2100, k))
            write(tmp_path, f"{name}_{k}", label_text(seen, msl_mast()))
    traverse = read_input(tmp_path)
    assert traverse.warnings == ()
    assert {eye.name for eye in traverse.rig.eyes} == {"nav-right-b", "mast-left"}
    assert len(traverse.frames) == 3


def test_exomars_is_read_with_the_cameras_of_the_template(pds4_folder: Path, tmp_path: Path) -> None:
    for eye, turn in (("l07", 20.0), ("r01", 20.0)):
        (file,) = pds4_folder.glob(f"pan_raw_sc_{eye}*.xml")
        text = re.sub(
            r'(pan</geom:index_name>\s*<geom:index_value_angle unit="deg">)0.0',
            rf"\g<1>{turn}",
            file.read_text(),
        )
        text = re.sub(r"(<img:first_(?:line|sample)>)1<", r"\g<1>101<", text)
        (tmp_path / file.name).write_text(text)
        (tmp_path / file.with_suffix(".dat").name).write_bytes(file.with_suffix(".dat").read_bytes())
    traverse = read_input(tmp_path)
    assert [eye.name for eye in traverse.rig.eyes] == ["wac-left", "wac-right"]
    assert len(traverse.frames) == 1
    assert np.rad2deg(traverse.frames[0].pan_rad) == pytest.approx(20.0)
    rotations, centres = traverse.camera_poses()
    assert np.linalg.norm(centres[0] - centres[1]) == pytest.approx(0.5, abs=1e-6)
    camera = traverse.rig.eyes[0].camera.pinhole
    # 1474 px of a detector whose pixels are averaged 2 x 2; the middle of the full image is at 255.5.
    np.testing.assert_allclose([camera.fx_px, camera.cx_px, camera.cy_px], [737.0, 155.5, 155.5], atol=1e-9)
    azimuth = np.rad2deg(np.arctan2(rotations[:, 1, 2], rotations[:, 0, 2]))
    np.testing.assert_allclose(azimuth, [20 - 1.4, 20 + 1.4], atol=1e-6)
    assert any("the template's stands in" in warning for warning in traverse.warnings)


@pytest.mark.parametrize(
    ("pattern", "by", "said"),
    [
        ("WACL<", "CLUPI<", "expected a camera of PanCam (WACL, WACR, HRC), found 'CLUPI'"),
        ("Mast PTU", "Arm", "expected pan and tilt of the Mast PTU, found none"),
        (
            "<img:lines>64",
            "<img:lines>65",
            "expected lines and samples as of the image, 64 and 64, found 65 and 64",
        ),
        (
            "first_line>1<",
            "first_line>1000<",
            "expected a part of 1024 x 1024 pixels, found 64 x 64 of 2 x 2 each",
        ),
        (
            "<img:width_pixels[^<]*",
            "<img:width_pixels>4",
            "expected height_pixels as width_pixels, 4, found 2",
        ),
    ],
)
def test_what_is_wrong_with_a_label_of_exomars_is_said(
    pds4_folder: Path, tmp_path: Path, pattern: str, by: str, said: str
) -> None:
    (file,) = pds4_folder.glob("pan_raw_sc_l07*.xml")
    changed, count = re.subn(pattern, by, file.read_text())
    assert count
    (tmp_path / "a.xml").write_text(changed)
    (tmp_path / file.with_suffix(".dat").name).write_bytes(file.with_suffix(".dat").read_bytes())
    with pytest.raises(InputError) as caught:
        read_input(tmp_path)
    assert said in str(caught.value)


def test_two_cameras_with_one_serial_number_are_two_and_named(tmp_path: Path) -> None:
    for k, name in enumerate(("NAV_RIGHT_B", "NAV_LEFT_B")):
        seen = Shot(head=navcam_b_head(), joints=POINTINGS[k], instrument=name, counter=(4, 2100, k))
        text = label_text(seen, msl_mast())
        text = text.replace("INSTRUMENT_ID", "INSTRUMENT_SERIAL_NUMBER = 215\r\nINSTRUMENT_ID", 1)
        write(tmp_path, f"{name}_{k}", text)
    traverse = read_input(tmp_path)
    assert len(traverse.rig.eyes) == 2
    assert traverse.warnings == (
        "NAV_LEFT_B, NAV_RIGHT_B have one serial number in their labels, 215; they are taken for cameras of "
        "their own",
    )
