"""Known surfaces, and pictures from above, as GeoTIFF: the first band, by rasterio of the extra `terrain`."""

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.extras import needed
from pancam_graph.base.geometry import FloatArray, IntArray
from pancam_graph.base.regular_files import instead_of_file
from pancam_graph.data import MapImage, Site, Surface
from pancam_graph.io._maps import (
    cell_m,
    crs_name,
    on_world_grid,
    require_same_body,
    world_affine,
    world_box_m,
)

__all__ = ["REACH_M", "read_map_image", "read_surface", "write_surface"]

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
    read = _read(path, near_m, site)
    height = read.values
    if read.is_map:
        assert site is not None  # `_read` has looked
        x, y = (
            f + s * np.arange(n) for f, s, n in zip(read.first, read.step, height.shape[::-1], strict=True)
        )
        fallen = (x * x + y[:, None] ** 2) / (2 * site.map_scale * site.shape.map_radius_m)
        height = height - site.height_m - fallen
    try:
        return Surface(first_m=read.first, step_m=read.step, height_m=height, file=path)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def read_map_image(path: Path, near_m: FloatArray | None = None, site: Site | None = None) -> MapImage:
    """A picture from above, the first band of a GeoTIFF; see `read_surface`, also for what it raises."""
    read = _read(path, near_m, site)
    return MapImage(first_m=read.first, step_m=read.step, grey=read.values)


class _Raster(NamedTuple):
    first: FloatArray
    step: FloatArray
    values: FloatArray
    is_map: bool


def _read(path: Path, near_m: FloatArray | None, site: Site | None) -> _Raster:
    found = instead_of_file(path)
    if found is not None:
        raise InputError(f"{path}: expected a GeoTIFF, found {found}")
    rasterio = needed("rasterio", "terrain")
    logging.getLogger("rasterio").setLevel(logging.ERROR)
    try:
        with rasterio.open(path, driver="GTiff") as file:
            crs = file.crs
            if crs is None or not (crs.is_projected or crs.is_geographic):
                raster = _in_world(file, path, near_m)
            elif site is None:
                raise InputError(
                    f"{path}: expected it in the world frame of the traverse (no coordinate system, or a "
                    f'local one), or a "site" in traverse.json; found {crs_name(crs)} and no site'
                )
            else:
                require_same_body(crs, site, path)
                raster = _of_map(file, path, np.zeros((1, 2)) if near_m is None else near_m, site)
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError, OSError) as error:
        raise InputError(f"{path}: expected a GeoTIFF, found: {_plain(error)}") from error
    if not np.isfinite(raster.values).any():
        raise InputError(f"{path}: expected data within {REACH_M:.0f} m of the stops, found none")
    return raster


def _in_world(file: Any, path: Path, near_m: FloatArray | None) -> _Raster:
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
    box = np.sort([first, first + (np.array([file.width, file.height]) - 1) * step], axis=0)
    size = _size(path, end - begin, box)
    window = needed("rasterio.windows", "terrain").Window(*begin.tolist(), *size)
    values = file.read(1, window=window, masked=True).astype(float).filled(np.nan)
    return _Raster(first + begin * step, step, values * file.scales[0] + file.offsets[0], is_map=False)


def _of_map(file: Any, path: Path, near_m: FloatArray, site: Site) -> _Raster:
    """The part of a map near the stops on the world's axes."""
    cell, box = cell_m(file, site), world_box_m(file, site)
    begin = np.floor(np.maximum(near_m.min(axis=0) - REACH_M, box[0]) / cell) * cell
    end = np.ceil((np.minimum(near_m.max(axis=0) + REACH_M, box[1]) - begin) / cell) + 1
    columns, rows = _size(path, end.astype(int), box)
    first, step = np.array([begin[0], begin[1] + (rows - 1) * cell]), np.array([cell, -cell])
    values = on_world_grid(file, site, first, step, (rows, columns))
    return _Raster(first, step, values * file.scales[0] + file.offsets[0], is_map=True)


def _size(path: Path, size: IntArray, box: FloatArray) -> tuple[int, int]:
    """Columns and rows of what is read; raises InputError for none and for too many."""
    if np.any(size < 1):
        (left, bottom), (right, top) = box
        raise InputError(
            f"{path}: expected data within {REACH_M:.0f} m of the stops, found it at x {left:.0f} to "
            f"{right:.0f} m, y {bottom:.0f} to {top:.0f} m"
        )
    columns, rows = (int(n) for n in size)
    if columns * rows > _MOST_NODES:
        raise InputError(
            f"{path}: expected at most {_MOST_NODES} nodes near the stops, found {columns} x {rows}"
        )
    return columns, rows


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
        transform=world_affine(None, corner[0], corner[1], step),
        nodata=np.nan,
        compress="deflate",
        BIGTIFF="IF_SAFER",
    ) as file:
        file.write(surface.height_m, 1)


def _plain(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
