"""Several products of one exposure are one image."""

from dataclasses import replace
from pathlib import Path

from pancam_graph.io import read_pds
from support.rover_labels import NAVCAM_B, POINTINGS, Shot, label_text, msl_mast, navcam_b_head, write

CLOCK = "516721703.665"


def product(
    folder: Path,
    name: str,
    *,
    clock: str | None = CLOCK,
    pointing: int = 0,
    linear: bool = False,
    tile: int = 1,
) -> None:
    head = navcam_b_head()
    head = replace(head, V=head.V - (tile - 1) * head.A)  # lines above the tile are not in its pixels
    text = label_text(Shot(head=head, joints=POINTINGS[pointing]), msl_mast())
    if linear:
        text = text.replace("MODEL_TYPE = CAHVOR", "MODEL_TYPE = CAHV")
    if clock is not None:
        text = text.replace("INSTRUMENT_ID", f'SPACECRAFT_CLOCK_START_COUNT = "{clock}"\r\nINSTRUMENT_ID', 1)
    text = text.replace("  LINES = 6", f"  FIRST_LINE = {tile}\r\n  LINES = 6")
    write(folder, name, text)


def names(folder: Path) -> tuple[list[str | None], tuple[str, ...]]:
    traverse = read_pds(folder)
    return [image.file for image in traverse.images], traverse.warnings


def test_the_best_of_several_products_is_used_and_the_others_named(tmp_path: Path) -> None:
    for kind in ("EDR", "RAD", "RAS"):
        product(tmp_path, f"NRB_516721703{kind}_F0540992CCAM15900M1")
    product(tmp_path, "NRB_516721703RAL_F0540992CCAM15900M1", linear=True)
    product(tmp_path, "NRB_516721799EDR_F0540992CCAM15900M1", clock="516721799.1", pointing=1)
    files, warnings = names(tmp_path)
    end = "_F0540992CCAM15900M1.IMG"
    assert files == [f"NRB_516721703RAD{end}", f"NRB_516721799EDR{end}"]
    assert warnings == (
        f"NRB_516721703RAD{end}: used of 4 products of one exposure; left out: NRB_516721703EDR{end}, "
        f"NRB_516721703RAL{end}, NRB_516721703RAS{end}",
    )


def test_more_pixels_and_more_bits_come_before_radiometry(tmp_path: Path) -> None:
    small = replace(NAVCAM_B, width_px=4, height_px=3)
    product(tmp_path, "NRB_516721703EDR_F")
    text = (tmp_path / "NRB_516721703EDR_F.IMG").read_bytes()[:8192].rstrip().decode()
    thumbnail = text.replace("LINES = 6", "LINES = 3").replace("LINE_SAMPLES = 8", "LINE_SAMPLES = 4")
    write(tmp_path, "NRB_516721703RAD_T", thumbnail, small)
    assert names(tmp_path)[0] == ["NRB_516721703EDR_F.IMG"]
    deep = tmp_path / "NRB_516721703ILF_F.IMG"
    deep.write_bytes(text.replace("SAMPLE_BITS = 8", "SAMPLE_BITS = 16").encode().ljust(8192) + bytes(96))
    assert names(tmp_path)[0] == [deep.name]


def test_other_clocks_other_eyes_and_no_clock_are_kept(tmp_path: Path) -> None:
    product(tmp_path, "NRB_0", clock=None)
    product(tmp_path, "NRB_1", clock=None, pointing=1)
    product(tmp_path, "NRB_2", pointing=2)
    product(tmp_path, "NRB_3", pointing=3, clock="1")
    other = tmp_path / "NRB_4.IMG"
    other.write_bytes((tmp_path / "NRB_2.IMG").read_bytes().replace(b"= NAV_RIGHT_B", b"= NAV_RIGHT_A"))
    files, warnings = names(tmp_path)
    assert files == [f"NRB_{k}.IMG" for k in range(5)]
    assert not any("products" in warning for warning in warnings)


def test_a_subframe_and_a_thumbnail_yield_to_the_full_frame(tmp_path: Path) -> None:
    product(tmp_path, "NRB_516721703EDR_F")
    head = navcam_b_head()
    for name, model, first in (
        ("NRB_516721703RAD_S", replace(head, width_px=4, height_px=3, V=head.V - 2 * head.A), 3),
        ("NRB_516721703RAD_T", replace(head, width_px=4, height_px=3, H=head.H / 2, V=head.V / 2), 1),
    ):
        part = label_text(Shot(head=model, joints=POINTINGS[0]), msl_mast())
        part = part.replace("INSTRUMENT_ID", f'SPACECRAFT_CLOCK_START_COUNT = "0{CLOCK}"\r\nINSTRUMENT_ID', 1)
        write(tmp_path, name, part.replace("  LINES = 3", f"  FIRST_LINE = {first}\r\n  LINES = 3"), model)
    files, warnings = names(tmp_path)
    assert files == ["NRB_516721703EDR_F.IMG"]
    assert warnings == (
        "NRB_516721703EDR_F.IMG: used of 3 products of one exposure; left out: NRB_516721703RAD_S.IMG, "
        "NRB_516721703RAD_T.IMG",
    )


def test_of_many_exposures_with_several_products_a_few_are_named(tmp_path: Path) -> None:
    for k in range(6):
        for kind in ("EDR", "RAD"):
            product(tmp_path, f"NRB_51672170{k}{kind}_F", clock=f"{k}.0", pointing=k)
    files, warnings = names(tmp_path)
    assert files == [f"NRB_51672170{k}RAD_F.IMG" for k in range(6)]
    said = [warning for warning in warnings if "product" in warning]
    assert len(said) == 6
    assert said[-1] == "1 more exposures have several products, of which one each is used"
