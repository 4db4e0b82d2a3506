"""Maps of a planet (GeoTIFF) and the world of a site: coordinate systems, and rasters drawn on its axes.

rasterio, of the extra `terrain`, does the projections.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.base.extras import needed
from pancam_graph.base.geometry import FloatArray
from pancam_graph.data import Site

__all__ = [
    "cell_m",
    "crs_name",
    "on_world_grid",
    "require_same_body",
    "site_crs",
    "world_affine",
    "world_box_m",
]

_OTHER_BODY = 0.006
"""Share by which the radius of a map's sphere differs from that of the site's body, and more."""
_FAR_M = 5e4
"""Distance up to which the edges of a map are nearly straight on a site's own map."""
_SPHEROID = re.compile(r'SPHEROID\["[^"]*",([0-9.eE+-]+),([0-9.eE+-]+)')


def crs_name(crs: Any) -> str:
    """Name of a coordinate system of rasterio's."""
    return str(crs.to_wkt().split('"')[1])[:80]


def site_crs(site: Site, name: str) -> Any:
    """The coordinate system, of rasterio, of metres east and north of a site: an oblique stereographic map.

    Its metres are those of the world: the map's sphere is scaled to the site's distance from the body's
    centre. Within 1 km they are the world's, turned to north, to 2 cm, and on Mars to 6 mm a metre of height:
    planetocentric latitudes change along the vertical.
    """
    rasterio = needed("rasterio", "terrain")
    geographic = rasterio.crs.CRS.from_user_input(site.shape.map_code).to_wkt()
    plain = "".join(c if c.isalnum() or c in " .-_" else "_" for c in name)[:80] or "traverse"
    return rasterio.crs.CRS.from_wkt(
        f'PROJCS["pancam-graph world of {plain} on {site.body}",{geographic},'
        'PROJECTION["Oblique_Stereographic"],'
        f'PARAMETER["latitude_of_origin",{site.latitude_deg!r}],'
        f'PARAMETER["central_meridian",{site.longitude_deg!r}],'
        f'PARAMETER["scale_factor",{site.map_scale!r}],'
        'PARAMETER["false_easting",0],PARAMETER["false_northing",0],'
        'UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    )


def world_affine(site: Site | None, left_m: float, top_m: float, step_m: FloatArray) -> Any:
    """The affine of rasterio from columns and rows along the world's axes to metres east and north.

    `left_m`, `top_m` are x and y of the corner of the first cell, `step_m` (2,) the steps along columns and
    rows. Without a site the result is in the world.
    """
    affine = needed("rasterio", "terrain").Affine
    own = affine(step_m[0], 0.0, left_m, 0.0, step_m[1], top_m)
    return own if site is None else affine.rotation(90.0 - np.degrees(site.north_rad)) @ own


def require_same_body(crs: Any, site: Site, path: Path) -> None:
    """Raise InputError unless a map is of the site's body, with latitudes as `Site` has them."""
    found = _SPHEROID.search(crs.to_wkt())
    radius, flattening = (float(number) for number in found.groups()) if found else (np.nan, np.nan)
    if not abs(radius / site.shape.map_radius_m - 1) < _OTHER_BODY:
        raise InputError(
            f"{path}: expected a map of {site.body} as the site has it, found {crs_name(crs)} of a "
            f"body with a radius of {radius / 1e3:.0f} km"
        )
    if bool(flattening) != site.shape.is_geodetic:
        expected = "geodetic latitudes" if site.shape.is_geodetic else "planetocentric latitudes, on a sphere"
        raise InputError(f"{path}: expected a map with {expected}, found {crs_name(crs)}")


def cell_m(file: Any, site: Site) -> float:
    """The smaller side of a map's cell at its middle, in metres of the world."""
    warp = needed("rasterio.warp", "terrain")
    middle = np.array([file.width, file.height]) / 2
    ends = middle + np.array([[0, 0], [1, 0], [0, 1]])
    x, y = np.array(file.transform).reshape(3, 3)[:2] @ np.column_stack([ends, np.ones(3)]).T
    across = np.array(warp.transform(file.crs, site_crs(site, ""), x.tolist(), y.tolist())[:2]).T
    return float(np.linalg.norm(across[1:] - across[0], axis=1).min())


def world_box_m(file: Any, site: Site) -> FloatArray:
    """Least and greatest x and y of the world (2, 2) of a map; infinite where it is too large to be drawn."""
    warp = needed("rasterio.warp", "terrain")
    steps = np.linspace(0.0, 1.0, 5)
    column, row = np.repeat(steps * file.width, len(steps)), np.tile(steps * file.height, len(steps))
    x, y = np.array(file.transform).reshape(3, 3)[:2] @ np.array([column, row, np.ones(len(row))])
    level = np.array(warp.transform(file.crs, site_crs(site, ""), x.tolist(), y.tolist())[:2]).T
    if not (np.all(np.isfinite(level)) and np.abs(level).max() < _FAR_M):
        return np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
    world = level @ site.level_R_world[:2, :2]
    return np.array([world.min(axis=0), world.max(axis=0)])


def on_world_grid(
    file: Any, site: Site, first_m: FloatArray, step_m: FloatArray, shape: tuple[int, int]
) -> FloatArray:
    """The first band of a map at the nodes of a grid of the world, by cubic convolution; NaN: there is none.

    `first_m` (2,) is the node of row 0 and column 0, `step_m` (2,) the steps along columns and rows.
    """
    corner = first_m - step_m / 2
    drawn = np.full(shape, np.nan)
    band = needed("rasterio", "terrain").band(file, 1)
    needed("rasterio.warp", "terrain").reproject(
        band,
        drawn,
        dst_crs=site_crs(site, ""),
        dst_transform=world_affine(site, corner[0], corner[1], step_m),
        dst_nodata=np.nan,
        resampling=needed("rasterio.enums", "terrain").Resampling.cubic,
        tolerance=0.0,
    )
    return drawn
