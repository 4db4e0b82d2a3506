"""Tables of localisation beside labels: where the drive is on Mars, and one sentence for what is wrong."""

from pathlib import Path

import numpy as np
import pytest

from pancam_graph.data import Site
from pancam_graph.io import read_input
from pancam_graph.io._places import is_places, site_by_places
from support.rover_labels import POINTINGS, Shot, label_text, msl_mast, navcam_b_head, write

HEAD = (
    "frame,site,drive,pose,landing_x,northing,"
    "planetocentric_latitude,planetodetic_latitude,longitude,elevation"
)
GALE = Site(body="Mars", latitude_deg=-4.61, longitude_deg=137.39, height_m=-4460.0, north_rad=0.0)
ROVERS = {(4, 2100): np.array([12.0, -3.0, 0.5]), (4, 2200): np.array([40.0, 8.0, 1.5])}


def row(frame: str, site: int, drive: int, place: np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    latitude, longitude, height = place.tolist()
    return f"{frame},{site},{drive},0,1.5,-271000,{latitude!r},0.0,{longitude!r},{height!r}"


def rover_rows(off_m: float = 0.0) -> list[str]:
    shifted = {key: at + np.array([off_m * (key[1] > 2100), 0.0, 0.0]) for key, at in ROVERS.items()}
    return [row("ROVER", *key, GALE.geographic(at[None])[0]) for key, at in shifted.items()]


def table(folder: Path, *rows: str, head: str = HEAD) -> Path:
    file = folder / "localized_interp.csv"
    file.write_text("\n".join([head, *rows]) + "\n")
    return file


def test_the_worlds_origin_is_found_from_a_rover_or_a_site(tmp_path: Path) -> None:
    """Both tell the same: a rover's row by the way back to the origin of its site."""
    origin = row("SITE", 4, 0, GALE.geographic(np.zeros((1, 3)))[0])
    for rows in (rover_rows(), [origin], [origin, *rover_rows()]):
        found = site_by_places(table(tmp_path, *rows), 4, ROVERS)
        assert found is not None
        assert found.warnings == ()
        assert found.site.points_m(GALE.geographic(np.eye(3))) == pytest.approx(np.eye(3), abs=1e-3)
        assert (found.site.body, found.site.north_rad) == ("Mars", 0.0)
    assert site_by_places(table(tmp_path, *rover_rows()), 5, {(5, 1): np.zeros(3)}) is None


def test_planetodetic_latitudes_are_turned_to_planetocentric_ones(tmp_path: Path) -> None:
    """Of a published row of Curiosity: -4.6438 planetodetic, -4.5895 planetocentric."""
    head = "FRAME,SITE,DRIVE,planetodetic_latitude,longitude,elevation"
    found = site_by_places(table(tmp_path, "SITE,3,0,-4.6438,137.4422,-4502.0", head=head), 3, {})
    assert found is not None
    assert found.site.latitude_deg == pytest.approx(-4.5895, abs=1e-4)


def test_a_table_that_differs_from_the_labels_is_warned_of(tmp_path: Path) -> None:
    found = site_by_places(table(tmp_path, *rover_rows(off_m=7.0)), 4, ROVERS)
    assert found is not None
    (warning,) = found.warnings
    assert "differ by up to 7.0 m from those of their labels (site 4, drive 2200)" in warning


def test_a_folder_of_labels_with_a_table_has_a_site(tmp_path: Path) -> None:
    for k in range(2):
        shot = Shot(head=navcam_b_head(), joints=POINTINGS[k], counter=(4, 2100, k))
        write(tmp_path, f"NRB_{k}", label_text(shot, msl_mast()))
    assert read_input(tmp_path).site is None
    (tmp_path / "notes.csv").write_text("sol,weather\n1,dust\n")
    table(tmp_path, "SITE,4,0,0,0,0,-4.61,0,137.39,-4460.0")
    traverse = read_input(tmp_path)
    assert traverse.site == GALE
    assert traverse.warnings == ()
    table(tmp_path, "SITE,4,0,0,0,0,-4.61,0,east,-4460.0")
    traverse = read_input(tmp_path)
    assert traverse.site is None
    assert "localized_interp.csv: line 2: longitude: expected a number, found 'east'" in traverse.warnings[0]
    table(tmp_path, "SITE,77,0,0,0,0,-4.61,0,137.39,-4460.0")
    assert "it has none of these sites and drives" in read_input(tmp_path).warnings[0]
    assert not is_places(tmp_path / "notes.csv")
