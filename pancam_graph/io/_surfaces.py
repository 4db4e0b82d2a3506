"""Known surfaces as GeoTIFF, heights in metres in the first band, by rasterio of the extra `terrain`."""

import logging
from pathlib import Path
from typing import Any

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.extras import needed
from pancam_graph.base.geometry import FloatArray
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.data import Site, Surface
from pancam_graph.io._maps import cell_m, crs_name, on_world_grid, require_same_body, world_box_m

__all__ = ["REACH_M", "read_surface", "write_surface"]

REACH_M = 1000.0
"""Of a surface, what lies within so many metres of the stops, along each axis, is read."""
_MOST_NODES = 1 << 26


def read_surface(path: Path, near_m: FloatArray | None = None, site: Site | None = None) -> Surface:
    """A surface whose columns and rows run along x and y of the world.

    `near_m` (n, 2) are places: only what lies within `REACH_M` of their box is read; default: all, of a map
    around the world's origin. A file without a coordinate system, or with a local one, is in the world frame.
    A map is drawn anew on the world's axes, in steps of its own cells, and its heights are taken from that of
    the `site`. Raises InputError naming the file where it is no such GeoTIFF, is a map without a site or of
    another body, or has more than 2^26 nodes there, and where the extra is missing.
    """
    found = instead_of_file(path)
    if found is not None:
        raise InputError(f"{path}: expected a GeoTIFF, found {found}")
    rasterio = needed("rasterio", "terrain")
    logging.getLogger("rasterio").setLevel(logging.ERROR)
    try:
        with rasterio.open(path, driver="GTiff") as file:
            crs = file.crs
            if crs is None or not (crs.is_projected or crs.is_geographic):
                return _read(file, path, near_m)
            if site is None:
                raise InputError(
                    f"{path}: expected heights in the world frame of the traverse (no coordinate system, or "
                    f'a local one), or a "site" in traverse.json; found {crs_name(crs)} and no site'
                )
            require_same_body(crs, site, path)
            return _from_map(file, path, np.zeros((1, 2)) if near_m is None else near_m, site)
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError, OSError) as error:
        raise InputError(f"{path}: expected a GeoTIFF, found: {_plain(error)}") from error


def _read(file: Any, path: Path, near_m: FloatArray | None) -> Surface:
    place = file.transform
    if place.b or place.d:
        raise InputError(f"{path}: expected columns along x and rows along y, found a turned raster")
    step = np.array([place.a, place.e])
    first = np.array([place.c, place.f]) + step / 2  # the node is the middle of its cell
    begin, end = np.zeros(2, dtype=int), np.array([file.width, file.height])
    if near_m is not None:
        corners = np.array([near_m.min(axis=0) - REACH_M, near_m.max(axis=0) + REACH_M])
        at = np.sort((corners - first) / step, axis=0)
        begin, end = np.clip([np.floor(at[0]), np.ceil(at[1]) + 1], 0, end).astype(int)
    size = end - begin
    if np.any(size < 1):
        raise InputError(
            f"{path}: expected heights within {REACH_M:.0f} m of the stops, found them at "
            f"x {_range(first, step, file.width, 0)}, y {_range(first, step, file.height, 1)}"
        )
    if int(size[0]) * int(size[1]) > _MOST_NODES:
        raise InputError(
            f"{path}: expected at most {_MOST_NODES} nodes near the stops, found {size[0]} x {size[1]}"
        )
    window = needed("rasterio.windows", "terrain").Window(*begin.tolist(), *size.tolist())
    height = file.read(1, window=window, masked=True).astype(float).filled(np.nan)
    return _surface(path, first + begin * step, step, height * file.scales[0] + file.offsets[0])


def _from_map(file: Any, path: Path, near_m: FloatArray, site: Site) -> Surface:
    """The part of a map near the stops on the world's axes: heights less the site's, and less its curve."""
    cell, (low, high) = cell_m(file, site), world_box_m(file, site)
    begin = np.floor(np.maximum(near_m.min(axis=0) - REACH_M, low) / cell) * cell
    size = np.ceil((np.minimum(near_m.max(axis=0) + REACH_M, high) - begin) / cell).astype(int) + 1
    if np.any(size < 1):
        raise InputError(
            f"{path}: expected heights within {REACH_M:.0f} m of the stops, found them at "
            f"x {low[0]:.0f} to {high[0]:.0f} m, y {low[1]:.0f} to {high[1]:.0f} m of the site"
        )
    columns, rows = int(size[0]), int(size[1])
    if columns * rows > _MOST_NODES:
        raise InputError(
            f"{path}: expected at most {_MOST_NODES} nodes near the stops, found {columns} x {rows}"
        )
    first, step = np.array([begin[0], begin[1] + (rows - 1) * cell]), np.array([cell, -cell])
    height = on_world_grid(file, site, first, step, (rows, columns)) * file.scales[0] + file.offsets[0]
    x, y = first[0] + cell * np.arange(columns), first[1] - cell * np.arange(rows)[:, None]
    fallen = (x * x + y * y) / (2 * site.map_scale * site.shape.map_radius_m)
    return _surface(path, first, step, height - site.height_m - fallen)


def _surface(path: Path, first: FloatArray, step: FloatArray, height: FloatArray) -> Surface:
    if not np.isfinite(height).any():
        raise InputError(f"{path}: expected heights within {REACH_M:.0f} m of the stops, found none")
    try:
        return Surface(first_m=first, step_m=step, height_m=height, file=path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def write_surface(surface: Surface, path: Path) -> None:
    """Write a surface that `read_surface` reads back to the last bit."""
    rasterio = needed("rasterio", "terrain")
    logging.getLogger("rasterio").setLevel(logging.ERROR)
    rows, columns = surface.height_m.shape
    corner, step = surface.first_m - surface.step_m / 2, surface.step_m
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=rows,
        width=columns,
        count=1,
        dtype="float64",
        transform=rasterio.Affine(step[0], 0.0, corner[0], 0.0, step[1], corner[1]),
        nodata=np.nan,
        compress="deflate",
        BIGTIFF="IF_SAFER",
    ) as file:
        file.write(surface.height_m, 1)


def _range(first: FloatArray, step: FloatArray, n: int, axis: int) -> str:
    ends = sorted([first[axis], first[axis] + (n - 1) * step[axis]])
    return f"{ends[0]:.0f} to {ends[1]:.0f} m"


def _plain(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
