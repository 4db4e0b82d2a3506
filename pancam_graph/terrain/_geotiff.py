"""Grids as GeoTIFF: height, sigma, count, disagreement, and the orthoimage; their levels joined by a VRT."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from pancam_graph.data import Site
from pancam_graph.io import site_crs, world_affine
from pancam_graph.terrain._extra import needed
from pancam_graph.terrain._fused import Fused
from pancam_graph.terrain._grid import Grid

__all__ = ["BANDS", "crs_wkt", "write_dem", "write_joined", "write_orthoimage"]

BANDS = ("height", "sigma", "count", "disagreement")
"""Names of the bands of `dem.tif`, in their order."""
_UNITS = ("metre", "metre", "frames", "metre")
_SMALLEST_OVERVIEW = 256
_TILE_PX = 256


def crs_wkt(name: str, site: Site | None) -> str:
    """The coordinate system of a traverse: metres east and north of its site, where it has one.

    Else its world frame: local metres, x to the right, y up, z up.
    """
    if site is not None:
        return str(site_crs(site, name).to_wkt())
    plain = "".join(c if c.isalnum() or c in " .-_" else "_" for c in name)[:80] or "traverse"
    return (
        f'LOCAL_CS["pancam-graph world of {plain}",LOCAL_DATUM["first mast, z up",32767],'
        'UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
    )


def write_dem(fused: Fused, path: Path, crs: str, site: Site | None) -> None:
    """Write the bands of a surface; NaN where nothing is known, which is the value for no data.

    Cells that were filled have a count of 0.
    Heights are z of the world; where there is a site, the band's offset makes them those of the planet.
    """
    bands = [fused.height_m, fused.sigma_m, fused.count, fused.disagreement_m]
    bands[2] = np.where(np.isfinite(fused.height_m), fused.count, np.float32(np.nan))
    _write(path, fused.grid, crs, site, bands, BANDS, _UNITS, np.nan)


def write_orthoimage(grey: NDArray[np.uint8], grid: Grid, path: Path, crs: str, site: Site | None) -> None:
    """Write brightness, 1 to 255; 0 is no data."""
    _write(path, grid, crs, site, [grey], ("brightness",), ("",), 0)


def write_joined(
    grids: Sequence[Grid], names: Sequence[str], path: Path, crs: str, site: Site | None, *, dem: bool
) -> None:
    """Write a VRT (GDAL's virtual raster) that shows some files beside it as one, the finest on top.

    `grids` are those of the files, the finest first; `dem` tells bands of heights from an orthoimage.
    """
    cell_m = grids[0].cell_m
    left, top = min(g.left_m for g in grids), max(g.top_m for g in grids)
    columns = max(round((g.left_m - left + g.columns * g.cell_m) / cell_m) for g in grids)
    rows = max(round((top - g.top_m + g.rows * g.cell_m) / cell_m) for g in grids)
    place = world_affine(site, left, top, np.array([cell_m, -cell_m]))
    kind, nodata = ("Float32", "nan") if dem else ("Byte", "0")
    bands, units = (BANDS, _UNITS) if dem else (("brightness",), ("",))
    parts = [f'<VRTDataset rasterXSize="{columns}" rasterYSize="{rows}">', f"<SRS>{escape(crs)}</SRS>"]
    to_gdal = ", ".join(repr(float(n)) for n in (place.c, place.a, place.b, place.f, place.d, place.e))
    parts.append(f"<GeoTransform>{to_gdal}</GeoTransform>")
    for number, (band, unit) in enumerate(zip(bands, units, strict=True), start=1):
        parts.append(f'<VRTRasterBand dataType="{kind}" band="{number}">')
        parts.append(f"<Description>{band}</Description><UnitType>{unit}</UnitType>")
        parts.append(f"<NoDataValue>{nodata}</NoDataValue>")
        if site is not None and dem and number == 1:
            parts.append(f"<Offset>{site.height_m!r}</Offset>")
        for grid, name in zip(reversed(grids), reversed(names), strict=True):
            step = round(grid.cell_m / cell_m)
            right, down = round((grid.left_m - left) / cell_m), round((top - grid.top_m) / cell_m)
            size = f'xSize="{step * grid.columns}" ySize="{step * grid.rows}"'
            parts.append(
                f'<ComplexSource><SourceFilename relativeToVRT="1">{name}</SourceFilename>'
                f"<SourceBand>{number}</SourceBand>"
                f'<SrcRect xOff="0" yOff="0" xSize="{grid.columns}" ySize="{grid.rows}"/>'
                f'<DstRect xOff="{right}" yOff="{down}" {size}/><NODATA>{nodata}</NODATA></ComplexSource>'
            )
        parts.append("</VRTRasterBand>")
    text = "\n".join([*parts, "</VRTDataset>"]) + "\n"
    path.write_text(text, encoding="utf-8", newline="\n")


def _write(
    path: Path,
    grid: Grid,
    crs: str,
    site: Site | None,
    bands: Sequence[NDArray[Any]],
    names: Sequence[str],
    units: Sequence[str],
    nodata: float,
) -> None:
    rasterio = needed("rasterio")
    logging.getLogger("rasterio").setLevel(logging.ERROR)
    resampling = needed("rasterio.enums").Resampling.average
    whole_numbers = bands[0].dtype == np.uint8
    place = world_affine(site, grid.left_m, grid.top_m, np.array([grid.cell_m, -grid.cell_m]))
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=grid.rows,
        width=grid.columns,
        count=len(bands),
        dtype=bands[0].dtype,
        crs=rasterio.crs.CRS.from_wkt(crs),
        transform=place,
        nodata=nodata,
        tiled=True,
        blockxsize=_TILE_PX,
        blockysize=_TILE_PX,
        compress="deflate",
        predictor=2 if whole_numbers else 3,
        zlevel=4,
        BIGTIFF="IF_SAFER",
    ) as file:
        for number, (band, name, unit) in enumerate(zip(bands, names, units, strict=True), start=1):
            file.write(band, number)
            file.set_band_description(number, name)
            if unit:
                file.set_band_unit(number, unit)
        if site is not None and not whole_numbers:
            file.offsets = (site.height_m, *(0.0 for _ in bands[1:]))
        levels = [2**k for k in range(1, 12) if max(grid.rows, grid.columns) >= _SMALLEST_OVERVIEW * 2**k]
        if levels:
            file.build_overviews(levels, resampling)
