"""A place on a planet: geodesy against PROJ, maps on the world's axes, and sentences for what is wrong."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pancam_graph import read_traverse, write_traverse
from pancam_graph.base.errors import InputError
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Site
from pancam_graph.io import read_surface, site_crs
from support.small_drives import simulated

rasterio = pytest.importorskip("rasterio")
warp = pytest.importorskip("rasterio.warp")
GALE = Site(body="Mars", latitude_deg=-4.5895, longitude_deg=137.4417, height_m=-4501.0, north_rad=0.3)
SITES = {
    "Gale": GALE,
    "north of Mars": Site(
        body="Mars", latitude_deg=68.2, longitude_deg=-125.7, height_m=-4100.0, north_rad=2.0
    ),
    "Moon": Site(body="Moon", latitude_deg=26.13, longitude_deg=3.63, height_m=-1900.0, north_rad=0.0),
    "Earth": Site(body="Earth", latitude_deg=-24.6, longitude_deg=359.0, height_m=2400.0, north_rad=-1.0),
}
PLATE = "+proj=eqc +lat_ts=0 +lon_0=0 +R={} +units=m +no_defs"


def fixed(site: Site, geographic: FloatArray) -> FloatArray:
    """Places in the body's frame by PROJ, which takes geodetic latitudes."""
    shape = site.shape
    axes = f"+a={shape.equator_m} +b={shape.pole_m} +no_defs"
    latitude = np.radians(geographic[:, 0])
    if not shape.is_geodetic:
        # Of a point above the ellipsoid the geodetic latitude has no closed form: by bisection.
        told, low, high = latitude, latitude - 0.01, latitude + 0.01
        for _ in range(60):
            latitude = (low + high) / 2
            radius = shape.equator_m / np.sqrt(1 - shape.e2 * np.sin(latitude) ** 2)
            z = (radius * (1 - shape.e2) + geographic[:, 2]) * np.sin(latitude)
            is_low = np.arctan2(z, (radius + geographic[:, 2]) * np.cos(latitude)) < told
            low, high = np.where(is_low, latitude, low), np.where(is_low, high, latitude)
    crs = rasterio.crs.CRS.from_string
    where = geographic[:, 1], np.degrees(latitude), geographic[:, 2]
    moved = warp.transform(
        crs(f"+proj=longlat {axes}"), crs(f"+proj=geocent {axes}"), *(list(one) for one in where)
    )
    return np.array(moved).T


@pytest.mark.parametrize("name", SITES)
def test_points_are_where_proj_has_them(name: str) -> None:

    site, rng = SITES[name], np.random.default_rng(1)
    points = rng.normal(0, 700.0, (40, 3))
    place = fixed(site, site.geographic(np.vstack([np.zeros(3), points])))
    told = [site.latitude_deg, site.longitude_deg, site.height_m]
    assert place[0] == pytest.approx(fixed(site, np.array([told]))[0], abs=1e-6)
    apart = np.linalg.norm(place[:, None] - place, axis=2)
    world = np.vstack([np.zeros(3), points])
    assert apart == pytest.approx(np.linalg.norm(world[:, None] - world, axis=2), abs=1e-5)  # it is rigid
    assert site.points_m(site.geographic(points)) == pytest.approx(points, abs=1e-6)
    up, north = np.array([[0.0, 0.0, 1.0]]), np.array([[np.cos(site.north_rad), np.sin(site.north_rad), 0.0]])
    assert site.geographic(up)[0, 2] == pytest.approx(site.height_m + 1.0, abs=1e-6)
    assert site.geographic(north)[0, 1] == pytest.approx(site.longitude_deg, abs=1e-9)
    assert site.geographic(north)[0, 0] > site.latitude_deg
    east = np.cross(north, up)
    assert site.geographic(east)[0, 1] > site.longitude_deg
    assert site.azimuth_deg(float(np.arctan2(*east[0, 1::-1]))) == pytest.approx(90.0)


@pytest.mark.parametrize("name", SITES)
def test_the_map_of_a_site_has_its_metres(name: str) -> None:
    site, rng = SITES[name], np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-700, 700, (40, 2)), rng.uniform(-1, 1, 40)])
    place = site.geographic(points)
    geographic = rasterio.crs.CRS.from_user_input(site.shape.map_code)
    moved = warp.transform(geographic, site_crs(site, "x"), place[:, 1].tolist(), place[:, 0].tolist())
    level = points @ site.level_R_world.T
    assert np.array(moved[:2]).T == pytest.approx(level[:, :2], abs=0.02)


def mapped(path: Path, site: Site, crs: str, *, offset: float = 0.0) -> Path:
    """A map of 2 km about a site whose heights are even slopes along its own axes."""
    here = rasterio.crs.CRS.from_user_input(site.shape.map_code)
    (x,), (y,), *_ = warp.transform(here, crs, [site.longitude_deg], [site.latitude_deg])
    cell, n = 5.0, 480
    column, row = np.arange(n), np.arange(n)[:, None]
    heights = site.height_m + 0.02 * cell * (column - n / 2) + 0.01 * cell * (row - n / 2)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=n,
        width=n,
        count=1,
        dtype="float64",
        crs=crs,
        transform=rasterio.Affine(cell, 0.0, x - cell * n / 2, 0.0, -cell, y + cell * n / 2),
    ) as file:
        file.write(heights - offset, 1)
        file.offsets = (offset,)
    return path


@pytest.mark.parametrize("name", ["Gale", "Moon"])
def test_heights_of_a_map_are_those_of_the_world_at_the_same_place(name: str, tmp_path: Path) -> None:
    site = SITES[name]
    plate = PLATE.format(site.shape.map_radius_m)
    path = mapped(tmp_path / "dem.tif", site, plate, offset=-100.0)
    surface = read_surface(path, np.zeros((1, 2)), site)
    rng = np.random.default_rng(3)
    rows = rng.integers(40, min(surface.height_m.shape) - 40, (60, 2))
    xy = surface.first_m + surface.step_m * rows[:, ::-1]
    place = site.geographic(np.column_stack([xy, surface.height_m[rows[:, 0], rows[:, 1]]]))
    here = rasterio.crs.CRS.from_user_input(site.shape.map_code)
    mx, my, *_ = warp.transform(here, plate, place[:, 1].tolist(), place[:, 0].tolist())
    with rasterio.open(path) as file:
        column, row = ~file.transform @ (np.array(mx), np.array(my))
    there = site.height_m + 0.1 * (column - 240.5) + 0.05 * (row - 240.5)
    inside = np.isfinite(place[:, 2])
    assert inside.sum() > 30
    assert place[inside, 2] == pytest.approx(there[inside], abs=0.01)


def test_a_map_needs_a_site_and_the_sites_body(tmp_path: Path) -> None:
    path = mapped(tmp_path / "dem.tif", GALE, PLATE.format(3396190))
    with pytest.raises(InputError, match=r'"site" in traverse.json; found .* and no site'):
        read_surface(path)
    for site, found in ((SITES["Moon"], "radius of 3396 km"), (SITES["Earth"], "radius of 3396 km")):
        with pytest.raises(InputError, match=rf"expected a map of {site.body} as the site has it, .*{found}"):
            read_surface(path, np.zeros((1, 2)), site)
    flat = tmp_path / "flat.tif"
    path.rename(flat)
    with rasterio.open(flat, "r+") as file:
        file.crs = rasterio.crs.CRS.from_string("+proj=eqc +a=3396190 +b=3376200 +units=m +no_defs")
    with pytest.raises(InputError, match="expected a map with planetocentric latitudes, on a sphere, found"):
        read_surface(flat, np.zeros((1, 2)), GALE)
    aside = replace(GALE, longitude_deg=137.9)
    with pytest.raises(InputError, match=r"dem.tif: expected data within 1000 m of the stops, found it at"):
        read_surface(mapped(path, GALE, PLATE.format(3396190)), np.zeros((1, 2)), aside)


def test_a_site_is_written_and_read_back(tmp_path: Path) -> None:
    write_traverse(replace(simulated(2, 2).traverse, site=GALE), tmp_path)
    assert read_traverse(tmp_path).site == GALE


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "body": ({"body": "Phobos"}, "site.body: expected"),
    "latitude": (
        {"latitude_deg": 91.0},
        "site: latitude_deg: expected a number from -89.999 to 89.999, found",
    ),
    "no north": ({"north_rad": None}, "site.north_rad: expected"),
    "degrees": ({"north_rad": 90.0}, "site: north_rad: expected a number from -10 to 10, found 90"),
    "unknown key": ({"elevation_m": 3.0}, "site.elevation_m: unknown key|unknown key"),
}


@pytest.mark.parametrize("name", WRONG)
def test_one_sentence_says_what_is_wrong(name: str, tmp_path: Path) -> None:
    write_traverse(replace(simulated(2, 2).traverse, site=GALE), tmp_path)
    content = json.loads((tmp_path / "traverse.json").read_text())
    changes, sentence = WRONG[name]
    content["site"] |= changes
    (tmp_path / "traverse.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=sentence) as raised:
        read_traverse(tmp_path)
    assert "\n" not in str(raised.value)
