"""Layers as a GeoPackage (OGC 12-128r18), which is an SQLite database."""

import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Site
from pancam_graph.results._gis_layers import Layer, Shape

__all__ = ["write_geopackage"]

_APPLICATION_ID = 0x47504B47
"""`GPKG`."""
_VERSION = 10300
_CARTESIAN = -1
"""Undefined Cartesian coordinates, as the world of a traverse without a site has them."""
_WKB: dict[Shape, int] = {"Point": 1001, "LineString": 1002, "Polygon": 1003}
"""Types of geometries with z."""
_WGS_84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY,
 organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL,
 definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
 identifier TEXT UNIQUE, description TEXT DEFAULT '',
 last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
 min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
 CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
 geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
 CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
 CONSTRAINT uk_gc_table_name UNIQUE (table_name),
 CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
 CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
"""


def write_geopackage(path: Path, layers: Sequence[Layer], site: Site | None) -> None:
    """Write layers, a table each; those without features are left out.

    Coordinates are longitude and latitude of the site's body and height, or the world's in metres.
    """
    with closing(sqlite3.connect(path)) as base, base:
        base.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        base.execute(f"PRAGMA user_version = {_VERSION}")
        base.executescript(_TABLES)
        systems = {row[1]: row for row in _systems(site)}
        base.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", systems.values())
        own = _CARTESIAN if site is None else int(site.shape.map_code.split(":")[1])
        for layer in layers:
            if layer.features:
                _write_layer(base, layer, own)


def _systems(site: Site | None) -> list[tuple[str, int, str, int, str, str]]:
    """The systems that every file has, and the site's."""
    undefined = "undefined"
    rows = [
        ("Undefined Cartesian SRS", _CARTESIAN, "NONE", _CARTESIAN, undefined, "Cartesian coordinates"),
        ("Undefined geographic SRS", 0, "NONE", 0, undefined, "undefined geographic coordinates"),
        ("WGS 84 geodetic", 4326, "EPSG", 4326, _WGS_84, "longitude and latitude on the WGS 84 spheroid"),
    ]
    if site is not None and site.body != "Earth":
        number, name = int(site.shape.map_code.split(":")[1]), f"{site.body} (2015) - Sphere"
        wkt = (
            f'GEOGCS["{name} / Ocentric",DATUM["{name}",SPHEROID["{name}",{site.shape.map_radius_m:.0f},0]],'
            f'PRIMEM["Reference Meridian",0],UNIT["degree",0.0174532925199433],AUTHORITY["IAU","{number}"]]'
        )
        rows.append((f"{name} / Ocentric", number, "IAU", number, wkt, "planetocentric"))
    return rows


def _write_layer(base: sqlite3.Connection, layer: Layer, srs_id: int) -> None:
    names = list(layer.features[0].properties)
    kinds = [_kind([one.properties[name] for one in layer.features]) for name in names]
    columns = "".join(f', "{name}" {kind}' for name, kind in zip(names, kinds, strict=True))
    base.execute(
        f'CREATE TABLE "{layer.name}" (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom BLOB{columns})'
    )
    at = np.concatenate([one.at for one in layer.features])
    bounds = (*at[:, :2].min(axis=0).tolist(), *at[:, :2].max(axis=0).tolist())
    base.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id) "
        "VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
        (layer.name, layer.name, *bounds, srs_id),
    )
    base.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 1, 0)",
        (layer.name, layer.shape.upper(), srs_id),
    )
    holders = ", ".join("?" * (len(names) + 1))
    quoted = "".join(f', "{name}"' for name in names)
    base.executemany(
        f'INSERT INTO "{layer.name}" (geom{quoted}) VALUES ({holders})',
        [(_blob(one.at, layer.shape, srs_id), *one.properties.values()) for one in layer.features],
    )


def _kind(values: list[str | int | float | None]) -> str:
    told = [v for v in values if v is not None]
    if all(isinstance(v, int) for v in told) and told:
        return "INTEGER"
    return "TEXT" if any(isinstance(v, str) for v in told) else "DOUBLE"


def _blob(at: FloatArray, shape: Shape, srs_id: int) -> bytes:
    """Places (n, 3) as a geometry of GeoPackage: header without an envelope, little-endian, and ISO WKB."""
    points = np.ascontiguousarray(at, dtype="<f8").tobytes()
    count = b"" if shape == "Point" else struct.pack("<I", len(at))
    rings = struct.pack("<I", 1) if shape == "Polygon" else b""
    return struct.pack("<2sBBiBI", b"GP", 0, 1, srs_id, 1, _WKB[shape]) + rings + count + points
