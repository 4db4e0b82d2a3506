"""Subframes and tiles are windows of one detector: one eye, and of one exposure one image.

Not shown: that tiles of the archive say first lines and samples as these labels do, which are made after the
one real label of a tile.
"""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph.base.errors import ImageError, InputError
from pancam_graph.cameras import CAHV
from pancam_graph.data import Image, Tile
from pancam_graph.io import picture_digests, read_pds, read_picture, read_traverse, write_traverse
from support.pds4_labels import pds4_text, real_text, write_pds4
from support.rover_labels import (
    MARS2020_NAVCAM,
    POINTINGS,
    Shot,
    label_text,
    mars2020_mast,
    misfits,
    msl_mast,
    navcam_b_head,
)

NAMES = ("NRB_1", "NRB_2", "NRB_3", "NRB_4")


def window(head: CAHV, left: int, top: int, width: int = 8, height: int = 6) -> CAHV:
    """The camera of a part of its picture."""
    return replace(
        head,
        width_px=width,
        height_px=height,
        H=head.H - left * head.A,
        V=head.V - top * head.A,
    )


def write(
    folder: Path,
    name: str,
    part: tuple[int, int, int, int],
    *,
    pointing: int = 0,
    clock: str = "1.0",
    told: tuple[int, int] | None = None,
    value: int = 1,
) -> Path:
    left, top, width, height = part
    first_sample, first_line = told or (1 + left, 1 + top)
    shot = Shot(head=window(navcam_b_head(), left, top, width, height), joints=POINTINGS[pointing])
    text = label_text(shot, msl_mast())
    text = text.replace("INSTRUMENT_ID", f'SPACECRAFT_CLOCK_START_COUNT = "{clock}"\r\nINSTRUMENT_ID', 1)
    entries = f"  FIRST_LINE = {first_line}\r\n  FIRST_LINE_SAMPLE = {first_sample}\r\n  LINES ="
    text = text.replace("  LINES =", entries, 1)
    file = folder / f"{name}.IMG"
    file.write_bytes(text.encode().ljust(8192) + bytes([value]) * (width * height))
    return file


def test_subframes_are_windows_of_one_eye_and_project_as_their_labels_say(tmp_path: Path) -> None:
    parts = [(0, 0, 16, 12), (4, 3, 8, 6), (8, 2, 8, 10), (0, 0, 16, 12)]
    for k, part in enumerate(parts):
        write(tmp_path, NAMES[k], part, pointing=k, clock=f"{k}.0", value=k + 1)
    traverse = read_pds(tmp_path)
    assert [eye.name for eye in traverse.rig.eyes] == ["nav-right-b"]
    assert [image.tiles for image in traverse.images] == [
        (),
        (Tile(file="NRB_2.IMG", left_px=4, top_px=3),),
        (Tile(file="NRB_3.IMG", left_px=8, top_px=2),),
        (),
    ]
    camera = traverse.rig.eyes[0].camera
    assert (camera.width_px, camera.height_px) == (16, 12)
    full = navcam_b_head()
    assert isinstance(camera, CAHV)
    assert (camera.cx_px, camera.cy_px) == pytest.approx((full.cx_px, full.cy_px), abs=2e-3)  # six digits
    assert max(misfits(traverse)) < 1e-5
    samples = read_picture(traverse, 1).samples
    assert (samples[3:9, 4:12] == 2).all()
    assert samples.sum() == 2 * 48


def test_tiles_of_an_exposure_are_one_image(tmp_path: Path) -> None:
    parts = [(0, 0, 8, 6), (6, 0, 8, 6), (0, 4, 8, 6), (6, 4, 8, 6)]
    for k, part in enumerate(parts):
        write(tmp_path, NAMES[k], part, value=k + 1)
    write(tmp_path, "NRB_5", (6, 4, 8, 6), pointing=1, clock="2.0", value=9)
    traverse = read_pds(tmp_path)
    assert [image.id for image in traverse.images] == ["NRB_1", "NRB_5"]
    assert traverse.images[0].files == tuple(f"{name}.IMG" for name in NAMES)
    assert len(traverse.frames) == 2
    assert len(traverse.rig.eyes) == 1
    samples = read_picture(traverse, 0).samples
    assert samples.shape == (10, 14)
    assert samples.min() > 0
    assert [int(samples[v, u]) for v, u in ((0, 0), (0, 13), (9, 0), (9, 13))] == [1, 2, 3, 4]
    assert np.count_nonzero(read_picture(traverse, 1).samples) == 48
    out = tmp_path / "written"
    write_traverse(traverse, out)
    again = read_traverse(out)
    assert again.images == traverse.images
    np.testing.assert_array_equal(read_picture(again, 0).samples, samples)
    before = picture_digests(again)
    (out / "NRB_4.IMG").write_bytes((out / "NRB_3.IMG").read_bytes())
    after = picture_digests(again)
    assert (before[0] != after[0], before[1] == after[1]) == (True, True)


@pytest.mark.parametrize("told", [(1, 1), (4, 4), (5, 5)])
def test_a_window_whose_place_and_camera_disagree_is_an_eye_of_its_own(
    tmp_path: Path, told: tuple[int, int]
) -> None:
    write(tmp_path, "NRB_1", (0, 0, 16, 12))
    write(tmp_path, "NRB_2", (4, 2, 8, 6), pointing=1, clock="2.0", told=told)
    traverse = read_pds(tmp_path)
    assert [eye.name for eye in traverse.rig.eyes] == ["nav-right-b", "nav-right-b-2"]
    assert not any(image.tiles for image in traverse.images)


def test_places_that_count_pixels_of_the_detector_are_told_by_the_camera(tmp_path: Path) -> None:
    write(tmp_path, "NRB_1", (0, 0, 16, 12))
    write(tmp_path, "NRB_2", (4, 2, 8, 6), pointing=1, clock="2.0", told=(9, 5))
    (tile,) = read_pds(tmp_path).images[1].tiles
    assert (tile.left_px, tile.top_px) == (4, 2)


def test_tiles_of_a_pds4_label(pds4_folder: Path, tmp_path: Path) -> None:
    real, mast = real_text(pds4_folder), mars2020_mast(as_designed=True)
    for k, (left, top) in enumerate(((0, 0), (1272, 952))):
        head = window(MARS2020_NAVCAM, left, top)
        text = pds4_text(real, NAMES[k], Shot(head=head, joints=(3.0, 1.5), instrument="NAVCAM_LEFT"), mast)
        for entry, first in (("first_line", 1 + top), ("first_sample", 1 + left)):
            text = re.sub(rf"(<img:{entry}>)\d+", rf"\g<1>{first}", text)
        write_pds4(tmp_path, NAMES[k], text, bytes([k + 1]) * 96)
    traverse = read_pds(tmp_path)
    (image,) = traverse.images
    assert image.tiles == (
        Tile(file="NRB_1.IMG", left_px=0, top_px=0),
        Tile(file="NRB_2.IMG", left_px=1272, top_px=952),
    )
    camera = traverse.rig.eyes[0].camera
    assert (camera.width_px, camera.height_px) == (1280, 958)
    assert isinstance(camera, CAHV)
    assert camera.cx_px == pytest.approx(MARS2020_NAVCAM.cx_px, abs=1e-3)


def test_wrong_tiles_are_said(tmp_path: Path) -> None:
    for k, part in enumerate([(0, 0, 8, 6), (6, 0, 8, 6)]):
        write(tmp_path, NAMES[k], part)
    out = tmp_path / "written"
    write_traverse(read_pds(tmp_path), out)
    content = json.loads((out / "traverse.json").read_text())
    content["images"][0]["tiles"][1]["left_px"] = 7
    (out / "traverse.json").write_text(json.dumps(content))
    with pytest.raises(ImageError, match=r"NRB_2.IMG: expected a tile of 14 x 6 .* from column 7"):
        read_traverse(out)
    content["images"][0]["tiles"][1]["left_px"] = -1
    (out / "traverse.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"NRB_1: tiles\[1\]: expected left_px and top_px of 0 or more"):
        read_traverse(out)
    content["images"][0]["file"] = "NRB_2.IMG"
    (out / "traverse.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"NRB_1: expected a file or tiles, found the file 'NRB_2.IMG'"):
        read_traverse(out)
    with pytest.raises(InputError, match="expected a file or tiles"):
        Image(id="a", frame="f", camera="c", file="b", tiles=(Tile(file="a", left_px=0, top_px=0),))
