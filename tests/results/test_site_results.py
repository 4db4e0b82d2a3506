"""What results say of a place on a planet: latitude, longitude, azimuth from north, maps with north up."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pancam_graph import Solution, solve
from pancam_graph.data import Site
from pancam_graph.io import read_surface
from pancam_graph.report import write_report
from pancam_graph.results import read_solution_json, write_results
from pancam_graph.terrain._fused import Fused
from pancam_graph.terrain._geotiff import crs_wkt, write_dem
from pancam_graph.terrain._grid import Grid
from support.small_drives import HARD, near_part, simulated

SITE = Site(body="Mars", latitude_deg=-4.5895, longitude_deg=137.4417, height_m=-4501.0, north_rad=0.3)


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve(replace(near_part(simulated(2, 2)), site=SITE), HARD)


def test_stops_and_images_have_their_place_and_azimuth(solution: Solution, tmp_path: Path) -> None:
    write_results(solution, tmp_path / "out", report=False)
    file = read_solution_json(tmp_path / "out" / "solution.json")
    assert file.site is not None
    assert file.site.site() == SITE
    degree_m = np.radians(1.0) * (3396190.0 - 4600.0)  # about: the ellipsoid is 130 m lower there
    for stop, pose in zip(file.stops, solution.final.world_T_mast, strict=True):
        assert stop.latitude_deg is not None
        assert stop.longitude_deg is not None
        assert stop.azimuth_deg is not None
        x, y, z = pose.translation()
        north = x * np.cos(0.3) + y * np.sin(0.3)
        east = x * np.sin(0.3) - y * np.cos(0.3)
        assert (stop.latitude_deg - SITE.latitude_deg) * degree_m == pytest.approx(north, abs=0.01)
        shrunk = degree_m * np.cos(np.radians(SITE.latitude_deg))
        assert (stop.longitude_deg - SITE.longitude_deg) * shrunk == pytest.approx(east, abs=0.01)
        assert stop.height_m == pytest.approx(SITE.height_m + z, abs=1e-3)
        yaw = np.degrees(pose.rotation().yaw())
        assert stop.azimuth_deg == pytest.approx((np.degrees(0.3) - yaw) % 360)
    axis = solution.final.world_R_camera[0][:, 2]
    azimuth = np.degrees(0.3 - np.arctan2(axis[1], axis[0])) % 360
    assert file.images[0].azimuth_deg == pytest.approx(azimuth)
    assert file.images[0].elevation_deg == pytest.approx(np.degrees(np.arcsin(axis[2])))


def test_without_a_site_nothing_is_said_of_north(tmp_path: Path) -> None:
    solution = solve(near_part(simulated(2, 2)), HARD)
    write_results(solution, tmp_path / "out", report=False)
    content = json.loads((tmp_path / "out" / "solution.json").read_text())
    assert "site" not in content
    assert not {"latitude_deg", "azimuth_deg"} & {*content["stops"][0], *content["images"][0]}


def test_the_report_says_what_is_up(solution: Solution, tmp_path: Path) -> None:
    write_report(solution, tmp_path / "north.html")
    write_report(replace(solution, traverse=replace(solution.traverse, site=None)), tmp_path / "local.html")
    north, local = ((tmp_path / name).read_text() for name in ("north.html", "local.html"))
    assert "North is up" in north
    assert "4.58950° S, 137.44170° E, planetocentric" in north
    assert "latitude (°)" in north
    assert "North is up" not in local
    assert "local frame" in local


def test_heights_of_terrain_lie_where_they_are_on_the_planet(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    warp = pytest.importorskip("rasterio.warp")
    grid = Grid(left_m=12.0, top_m=30.0, cell_m=0.5, rows=40, columns=60)
    x, y = grid.middles()
    height = (0.1 * x + 0.05 * y[:, None]).astype(np.float32)
    fused = Fused(
        grid=grid,
        height_m=height,
        sigma_m=height,
        count=height,
        disagreement_m=height,
        grey=height,
        telemetry_m=height,
    )
    write_dem(fused, tmp_path / "dem.tif", crs_wkt("a drive", SITE), SITE)
    with rasterio.open(tmp_path / "dem.tif") as file:
        east, north = file.xy(7, 11)
        geographic = rasterio.crs.CRS.from_user_input("IAU_2015:49900")
        (longitude,), (latitude,), *_ = warp.transform(file.crs, geographic, [east], [north])
        assert file.offsets[0] == SITE.height_m
    place = SITE.geographic(np.array([[x[11], y[7], height[7, 11]]]))[0]
    assert np.array([latitude, longitude]) == pytest.approx(place[:2], abs=1e-7)
    again = read_surface(tmp_path / "dem.tif", np.zeros((1, 2)), SITE)
    at = np.array([[20.0, 20.0], [30.0, 18.0]])
    assert again.covers(at).all()
    column, row = np.rint((at - again.first_m) / again.step_m).astype(int).T
    node = again.first_m + again.step_m * np.column_stack([column, row])
    assert again.height_m[row, column] == pytest.approx(node @ [0.1, 0.05], abs=1e-3)
