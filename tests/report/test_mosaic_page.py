"""The page of mosaics: every mosaic with its place in the world, whatever its names are."""

import json
import re
from typing import Any

import pytest

from pancam_graph.report._mosaic_page import make_mosaic_page

CYLINDER: dict[str, Any] = {
    "stop": "</script><script>alert(1)</script>",
    "camera": "left",
    "kind": "cylinder",
    "images": ["a", "b"],
    "files": {"telemetry": "001-1_s_left_telemetry.png", "refined": "001-1_s_left_refined.png"},
    "width_px": 7712,
    "height_px": 1196,
    "px_per_degree": 21.4,
    "left_azimuth_deg": 180.0,
    "top_elevation_deg": 15.9,
}
GROUND: dict[str, Any] = {
    **{k: CYLINDER[k] for k in ("camera", "images", "files")},
    "stop": "s",
    "kind": "ground",
    "width_px": 2000,
    "height_px": 2000,
    "m_per_px": 0.01,
    "left_x_m": -10.0,
    "top_y_m": 10.0,
}


@pytest.mark.parametrize("north_deg", [None, 72.5])
def test_every_mosaic_is_listed_with_what_tells_its_place(north_deg: float | None) -> None:
    page = make_mosaic_page([CYLINDER, GROUND], north_deg, "a drive")
    (text,) = re.findall(r'id="mosaics-listed">(.*?)</script>', page)
    listed = json.loads(text)
    assert listed["north_deg"] == north_deg
    first, second = listed["mosaics"]
    assert (first["left_azimuth_deg"], first["px_per_degree"]) == (180.0, 21.4)
    assert (second["left_x_m"], second["m_per_px"]) == (-10.0, 0.01)
    assert first["files"]["refined"] == "001-1_s_left_refined.png"
    assert "images" not in first  # hundreds of names that the page has no use for
    assert page.count("<option value=") == 4  # two mosaics, two pointings
    assert "<script>alert(1)" not in page


def test_other_views_are_linked() -> None:
    files = CYLINDER["files"] | {"refined_polar": "a b_polar.jpg", "anaglyph_right<": "x_anaglyph.jpg"}
    page = make_mosaic_page([CYLINDER | {"files": files}, GROUND], None, "a drive")
    assert re.findall(r'<li><a href="([^"]+)">', page) == ["a%20b_polar.jpg", "x_anaglyph.jpg"]
    assert "right&lt;, for red and cyan glasses" in page
    assert "Other views" not in make_mosaic_page([CYLINDER, GROUND], None, "a drive")
