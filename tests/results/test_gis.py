"""The export for GIS programs: places, shapes and systems as the formats' own specifications have them."""

import json
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree  # what is parsed was written here

import numpy as np
import pytest

from pancam_graph import Solution, solve
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Site
from pancam_graph.results import write_gis, write_results
from support.small_drives import HARD, near_part, simulated

SITE = Site(body="Mars", latitude_deg=-4.5895, longitude_deg=137.4417, height_m=-4501.0, north_rad=0.3)


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve(near_part(simulated(2, 2)), replace(HARD, landmark_covariances=True))


def placed(solution: Solution) -> Solution:
    return replace(solution, traverse=replace(solution.traverse, site=SITE))


def geometry(blob: bytes) -> tuple[int, FloatArray]:
    """System and places of a geometry, by OGC 12-128r18 2.1.3 and ISO WKB."""
    magic, version, flags, srs_id = struct.unpack_from("<2sBBi", blob)
    assert (magic, version, flags) == (b"GP", 0, 1)
    order, kind = struct.unpack_from("<BI", blob, 8)
    assert order == 1
    begin = 13
    if kind == 1003:
        assert struct.unpack_from("<I", blob, begin) == (1,)
        begin += 4
    n = 1
    if kind != 1001:
        (n,) = struct.unpack_from("<I", blob, begin)
        begin += 4
    assert len(blob) == begin + 24 * n
    return srs_id, np.frombuffer(blob, "<f8", 3 * n, begin).reshape(n, 3)


def rows(base: sqlite3.Connection, layer: str) -> Iterator[tuple[int, FloatArray]]:
    for (blob,) in base.execute(f'SELECT geom FROM "{layer}" ORDER BY fid'):
        yield geometry(blob)


def test_a_geopackage_has_places_of_the_planet_and_its_system(solution: Solution, tmp_path: Path) -> None:
    write_gis(placed(solution), tmp_path / "gis")
    with closing(sqlite3.connect(tmp_path / "gis" / "drive.gpkg")) as base:
        assert base.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert base.execute("PRAGMA foreign_key_check").fetchall() == []
        layers = dict(base.execute("SELECT table_name, geometry_type_name FROM gpkg_geometry_columns"))
        assert layers == {
            "stops": "POINT",
            "drive": "LINESTRING",
            "ellipses": "POLYGON",
            "views": "POLYGON",
            "landmarks": "POINT",
        }
        (wkt,) = base.execute("SELECT definition FROM gpkg_spatial_ref_sys WHERE srs_id = 49900").fetchone()
        assert 'SPHEROID["Mars (2015) - Sphere",3396190,0]' in wkt
        systems, stops = zip(*rows(base, "stops"), strict=True)
        assert set(systems) == {49900}
        world = np.array([pose.translation() for pose in solution.final.world_T_mast])
        assert np.concatenate(stops) == pytest.approx(SITE.geographic(world)[:, [1, 0, 2]], abs=1e-12)
        points = np.concatenate([at for _, at in rows(base, "landmarks")])
        finite = np.isfinite(solution.final.landmarks_m).all(axis=1)
        assert points == pytest.approx(SITE.geographic(solution.final.landmarks_m[finite])[:, [1, 0, 2]])
        box = base.execute("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = 'stops'")
        both = np.concatenate(stops)[:, :2]
        assert box.fetchone() == pytest.approx((*both.min(axis=0), *both.max(axis=0)))


def test_ellipses_and_views_have_their_size(solution: Solution, tmp_path: Path) -> None:
    """In the world, without a site: metres."""
    write_gis(solution, tmp_path / "gis")
    assert not list((tmp_path / "gis").glob("*.geojson"))
    with closing(sqlite3.connect(tmp_path / "gis" / "drive.gpkg")) as base:
        ((srs_id, outline),) = rows(base, "ellipses")  # of the second stop: the first is held
        assert srs_id == -1
        pose, covariance = solution.final.world_T_mast[1], solution.stop_covariance[1]
        R = pose.rotation().matrix()
        in_world = (R @ covariance[3:, 3:] @ R.T)[:2, :2]
        off = outline[:, :2] - pose.translation()[:2]
        # 95 % of a plane normal distribution lie within a squared distance of -2 ln 0.05.
        assert np.einsum("ij,jk,ik->i", off, np.linalg.inv(in_world), off) == pytest.approx(-2 * np.log(0.05))
        for (_, at), image, R in zip(
            rows(base, "views"), range(10**6), solution.final.world_R_camera, strict=False
        ):
            assert at[0] == pytest.approx(solution.final.world_t_camera[image])
            sides = at[1:3, :2] - at[0, :2]
            assert np.linalg.norm(sides, axis=1) == pytest.approx(10.0)
            right, left = sides / 10
            axis = R[:2, 2] / np.linalg.norm(R[:2, 2])
            assert right @ axis == pytest.approx(left @ axis, abs=0.02)
            assert right[0] * left[1] - right[1] * left[0] > 0  # anticlockwise


def test_geojson_and_kml_have_the_same_places(solution: Solution, tmp_path: Path) -> None:
    write_results(placed(solution), tmp_path / "out", report=False, exports=("gis",))
    folder = tmp_path / "out" / "gis"
    content = json.loads((folder / "stops.geojson").read_text())
    assert content["crs"]["properties"]["name"] == "urn:ogc:def:crs:IAU:2015:49900"
    world = np.array([pose.translation() for pose in solution.final.world_T_mast])
    at = [one["geometry"]["coordinates"] for one in content["features"]]
    again = SITE.points_m(np.array(at)[:, [1, 0, 2]])
    assert again == pytest.approx(world, abs=1e-3)
    assert [one["properties"]["stop"] for one in content["features"]] == ["stop0000", "stop0001"]
    views = json.loads((folder / "views.geojson").read_text())["features"]
    ring = np.array(views[0]["geometry"]["coordinates"][0])
    assert np.array_equal(ring[0], ring[-1])
    root = ElementTree.fromstring((folder / "drive.kml").read_text())
    assert root.attrib["hint"] == "target=mars"
    marks = [e.text for e in root.iter("{http://www.opengis.net/kml/2.2}coordinates")]
    first = np.array(str(marks[0]).split(","), dtype=float)
    assert first == pytest.approx(np.array(at[0]), abs=1e-3)
    listed = json.loads((folder / "export.json").read_text())["files"]
    assert {"drive.gpkg", "drive.kml", "stops.geojson", "landmarks.geojson"} <= set(listed)


def test_gdal_opens_all_layers_with_their_places(solution: Solution, tmp_path: Path) -> None:
    """A reader that is not ours: GDAL, as the package pyogrio has it."""
    gdal = pytest.importorskip("pyogrio", reason="GDAL (pyogrio) is not installed")
    write_results(placed(solution), tmp_path / "out", report=False, exports=("gis",))
    folder = tmp_path / "out" / "gis"
    layers = dict(gdal.list_layers(folder / "drive.gpkg").tolist())
    assert {name: kind.removesuffix(" Z") for name, kind in layers.items()} == {
        "stops": "Point",
        "drive": "LineString",
        "ellipses": "Polygon",
        "views": "Polygon",
        "landmarks": "Point",
    }
    world = np.array([pose.translation() for pose in solution.final.world_T_mast])
    expected = SITE.geographic(world)[:, [1, 0]]
    for file, layer in ((folder / "drive.gpkg", "stops"), (folder / "stops.geojson", None)):
        info = gdal.read_info(file, layer=layer)
        assert info["features"] == len(solution.traverse.stops)
        assert "Mars" in info["crs"]
        _, _, geometry, _ = gdal.raw.read(file, layer=layer)
        places = np.array([np.frombuffer(one[5:21], dtype="<f8") for one in geometry])
        assert places == pytest.approx(expected, abs=1e-9)
