"""The section of terrain: what it shows are the heights of the files, and it stays small."""

import base64
import gzip
import json
import re
from typing import Any

import numpy as np
import pytest

from pancam_graph.base.geometry import FloatArray
from pancam_graph.report._terrain import make_terrain_page, terrain_section
from pancam_graph.report._terrain_script import UNKNOWN
from pancam_graph.terrain import Fused, Section, ShownSurface, WrittenTerrain
from pancam_graph.terrain._grid import Grid
from pancam_graph.terrain._shown import shown_surface


def surface(title: str = "stop A", size: int = 90, *, telemetry: bool = True) -> ShownSurface:
    """A hill of 2 m with a hole in it, seen from above."""
    row, column = np.mgrid[:size, :size]
    height = (2 * np.exp(-((row - 30) ** 2 + (column - 50) ** 2) / 400)).astype(np.float32)
    height[60:70, 60:80] = np.nan
    other = height + np.float32(0.05)
    fused = Fused(
        grid=Grid(left_m=100.0, top_m=-40.0, cell_m=0.05, rows=size, columns=size),
        height_m=height,
        sigma_m=np.full_like(height, 0.004),
        count=np.ones_like(height),
        disagreement_m=np.full_like(height, np.nan),
        grey=np.full_like(height, 90.0),
        telemetry_m=other if telemetry else np.full_like(height, np.nan),
    )
    return shown_surface(fused, np.full(height.shape, 90, np.uint8), title, {"mesh": "A/mesh.glb"})


def written(*surfaces: ShownSurface) -> WrittenTerrain:
    along = np.linspace(0.0, 3.0, 61)
    section = Section(
        frames=(0, 2),
        ends_m=((1.0, 2.0), (4.0, 2.0)),
        along_m=along,
        refined_m=np.array([0.1 * along, np.where(along > 2, np.nan, 0.1 * along)], dtype=np.float32),
        telemetry_m=np.array([0.1 * along, 0.1 * along + 0.2], dtype=np.float32),
    )
    return WrittenTerrain(
        surfaces=surfaces,
        lines=("3 stereo frames",),
        section=section,
        frame_ids=("f0", "f1", "<f2>"),
        warnings=(),
    )


def described(page: str) -> list[dict[str, Any]]:
    (text,) = re.findall(r'id="terrain-surfaces">(.*?)</script>', page)
    found: list[dict[str, Any]] = json.loads(text)
    return found


def bands(page: str, number: int) -> FloatArray:
    """Bands (3, rows, columns) of a surface, read as the script of the page does."""
    (text,) = re.findall(r'id="packed-terrain">(.*?)</script>', page)
    codes = np.frombuffer(gzip.decompress(base64.b64decode(text)), "<i2").astype(float)
    about = described(page)[number]
    count = 3 * about["rows"] * about["columns"]
    own = codes[about["first"] : about["first"] + count].reshape(3, about["rows"], about["columns"])
    base, step = (np.array(about[name])[:, None, None] for name in ("base", "step"))
    return np.where(own == UNKNOWN, np.nan, base + own * step)


def test_heights_of_the_page_are_those_of_the_surfaces() -> None:
    shown = [surface(), surface("stop B", 70, telemetry=False)]
    page = make_terrain_page(written(*shown), "a drive")
    for number, own in enumerate(shown):
        refined, telemetry, sigma = bands(page, number)
        np.testing.assert_allclose(refined, own.refined_m, atol=1e-4)
        np.testing.assert_allclose(telemetry, own.telemetry_m, atol=1e-4)
        np.testing.assert_allclose(sigma, own.sigma_m, atol=1e-4)
    first, second = described(page)
    assert (first["left"], first["top"], first["cell"]) == (100.0, -40.0, 0.05)
    assert first["telemetry"]
    assert not second["telemetry"]
    (a, b) = first["line"]
    assert a[1] == b[1] < -40.0
    assert 100.0 < a[0] < b[0] < 104.5


def test_a_large_grid_is_averaged_over_blocks_that_see_something() -> None:
    shown = surface(size=1000)
    assert shown.grid.cell_m == pytest.approx(0.15)
    assert shown.refined_m.shape == (334, 334)
    assert shown.wide_m == pytest.approx(50.0)  # of the pictures: the last block is not whole
    np.testing.assert_allclose(shown.refined_m[10, 16], 2.0, atol=0.02)  # the summit, at row 30 and column 50
    assert np.isnan(shown.refined_m[21, 22])  # within the hole
    np.testing.assert_allclose(shown.sigma_m[0, 0], 0.004, rtol=1e-5)
    assert max(shown.width_px, shown.height_px) == 1000


def test_stops_that_the_page_has_no_room_for_are_counted() -> None:
    large = surface(size=400)
    page = terrain_section(written(*[large] * 9), "terrain/")
    assert len(described(page)) == page.count('<figure class="relief"') < 9
    assert f"{9 - len(described(page))} more stops are in the folder only" in page
    assert len(page) < 4_000_000


def test_names_cannot_leave_their_place() -> None:
    page = terrain_section(written(surface("</script><script>alert(1)")), "terrain/")
    assert "<script>alert(1)" not in page
    assert 'href="terrain/A/mesh.glb"' in page


def drawn(panel: str, name: str) -> FloatArray:
    """Corners (n, 2) of the longest line of a class in a panel."""
    paths = re.findall(rf'<path class="{name}" d="([^"]*)"', panel)
    corners = re.findall(r"[ML]([\d.-]+) ([\d.-]+)", max(paths, key=len))
    return np.array(corners, dtype=float)


def test_two_frames_in_section_part_with_telemetry_and_meet_refined() -> None:
    page = terrain_section(written(surface()), "")
    before, after = re.findall(r'<svg class="section".*?</svg>', page, flags=re.DOTALL)
    a, b = drawn(before, "first"), drawn(before, "second")
    np.testing.assert_allclose(a[:, 0], b[:, 0])
    gap = (a - b)[:, 1]
    assert gap.min() > 50  # pixels: the second frame lies higher
    np.testing.assert_allclose(gap, gap[0], atol=0.2)
    a, b = drawn(after, "first"), drawn(after, "second")
    assert len(b) == 41  # what the second frame does not see is a gap
    np.testing.assert_allclose(a[: len(b)], b, atol=0.2)
    assert "f0 and &lt;f2&gt; see of the same ground, in section from (1.0, 2.0) to (4.0, 2.0) m" in page
