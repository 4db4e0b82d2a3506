"""Terrain as files: one set for the drive, one for each stop, and what is where."""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pancam_graph.charts import Picture, encoded
from pancam_graph.data import Site, Traverse
from pancam_graph.io import TERRAIN_FORMAT, VERSION
from pancam_graph.terrain._cloud import write_cloud, write_ply
from pancam_graph.terrain._extra import require_extra
from pancam_graph.terrain._fused import Fused
from pancam_graph.terrain._geotiff import BANDS, crs_wkt, write_dem, write_joined, write_orthoimage
from pancam_graph.terrain._levels import composed
from pancam_graph.terrain._make import Cloud, Terrain
from pancam_graph.terrain._mesh import write_mesh
from pancam_graph.terrain._pictures import hillshade_picture, slope_picture
from pancam_graph.terrain._shown import ShownSurface, WrittenTerrain, shown_surface
from pancam_graph.terrain._terrain_options import TerrainOptions

__all__ = ["TERRAIN_INDEX", "TERRAIN_PAGE", "write_terrain"]

TERRAIN_INDEX = "terrain.json"
"""The file in a folder of terrain that lists the others."""
TERRAIN_PAGE = "terrain.html"
"""The page of a folder of terrain, which the index does not list: whoever writes reports writes it."""
_FILES = {
    "dem": "dem.tif",
    "orthoimage": "orthoimage.tif",
    "dem_whole": "dem.vrt",
    "orthoimage_whole": "orthoimage.vrt",
    "hillshade_whole": "hillshade_all.png",
    "hillshade": "hillshade.png",
    "slope": "slope.png",
    "mesh": "mesh.glb",
    "cloud": "cloud.laz",
    "cloud_ply": "cloud.ply",
}
_STRETCH = 0.005, 0.995
_LONGEST_NAME = 60
_WHOLE_CELLS = 1600
"""Cells along the longer side of a surface and its coarser levels as one picture, at most."""

Json = dict[str, object]
Progress = Callable[[str, int, int], None]


def write_terrain(
    terrain: Terrain,
    traverse: Traverse,
    folder: Path,
    options: TerrainOptions = TerrainOptions(),  # noqa: B008  frozen
    *,
    progress: Progress | None = None,
) -> WrittenTerrain:
    """Write terrain into a folder, which must exist and be empty (docs/files.md).

    Returns what a report shows of it. Raises InputError where a package of the extra `terrain` is missing.
    """
    require_extra()
    site = traverse.site
    crs = crs_wkt(traverse.name, site)
    names = _folder_names(list(terrain.stops))
    sets: list[tuple[str | None, str, Fused, Sequence[Cloud]]] = [
        (None, "", terrain.drive, list(terrain.clouds.values()))
    ]
    sets += [(stop, names[stop], fused, [terrain.clouds[stop]]) for stop, fused in terrain.stops.items()]
    products, surfaces = list[Json](), list[ShownSurface]()
    for n, (stop, name, fused, clouds) in enumerate(sets):
        place = folder / name if name else folder
        place.mkdir(exist_ok=True)
        title = f"traverse {traverse.name}" if stop is None else f"stop {stop}"
        product, shown = _write_set(fused, clouds, place, name, stop, title, crs, site, options)
        products.append(product)
        if stop is None:
            surfaces += shown
        elif len(terrain.stops) > 1:
            surfaces.append(shown[0])
        if progress is not None:
            progress("writing terrain", n + 1, len(sets))
    whole = {
        "format": TERRAIN_FORMAT,
        "version": VERSION,
        "cell_m": terrain.drive.grid.cell_m,
        "crs": {
            "name": "world frame of the traverse, z up, metres"
            if site is None
            else f"metres east and north of the site on {site.body}; heights are of the world, z up",
            "wkt": crs,
        },
        "disagreement_m": _both(terrain, same_stop=None),
        "disagreement_sigmas": _number(terrain.agreement.median_sigmas),
        "disagreement_within_stops_m": _both(terrain, same_stop=True),
        "disagreement_between_stops_m": _both(terrain, same_stop=False),
        "pairs": _pairs(terrain, traverse),
        "products": products,
        "warnings": list(terrain.warnings),
    }
    text = json.dumps(whole, indent=1, allow_nan=False, ensure_ascii=False)
    (folder / TERRAIN_INDEX).write_text(text + "\n", encoding="utf-8", newline="\n")
    return WrittenTerrain(
        surfaces=tuple(surfaces),
        lines=tuple(terrain.says()),
        section=terrain.section,
        frame_ids=tuple(frame.id for frame in traverse.frames),
        warnings=terrain.warnings,
    )


def _write_set(
    fused: Fused,
    clouds: Sequence[Cloud],
    place: Path,
    name: str,
    stop: str | None,
    title: str,
    crs: str,
    site: Site | None,
    options: TerrainOptions,
) -> tuple[Json, list[ShownSurface]]:
    """Write the files of one surface; returns its entry in the index, and what a report shows of it."""
    limits = _limits(fused.grey)
    greys = [_stretched(level.grey, limits) for level in fused.levels]
    written = _rasters(fused, greys, place, crs, site)
    _save(place / _FILES["hillshade"], hillshade_picture(fused, title))
    _save(place / _FILES["slope"], slope_picture(fused, title))
    whole = composed(fused, _across_m(fused) / _WHOLE_CELLS)
    if fused.coarser:
        _save(place / _FILES["hillshade_whole"], hillshade_picture(whole, f"{title}, all"))
    triangles = write_mesh(fused, greys, place / _FILES["mesh"], options.most_mesh_cells)
    points = write_cloud(clouds, place / _FILES["cloud"], crs, site)
    if options.ply:
        write_ply(clouds, place / _FILES["cloud_ply"], site)
    left_out = {"cloud_ply"} if not options.ply else set[str]()
    left_out |= set[str]() if fused.coarser else {"dem_whole", "orthoimage_whole", "hillshade_whole"}
    written = {kind: file for kind, file in _FILES.items() if kind not in left_out} | written
    files = {kind: f"{name}/{file}" if name else file for kind, file in written.items()}
    seen = fused.count > 0
    entry: Json = {
        "stop": stop,
        "files": files,
        "bands": list(BANDS),
        **_level(fused),
        "coarser": [_level(level) for level in fused.coarser],
        "frames": sorted({int(f) for c in clouds for f in np.unique(c.frame)}),
        "points": points,
        "triangles": triangles,
        "median_sigma_m": _number(float(np.median(fused.sigma_m[seen]))),
    }
    shown = [shown_surface(fused, greys[0], title, files)]
    if fused.coarser:
        grey = _stretched(whole.grey, limits)
        far_m = _across_m(fused)
        shown.append(shown_surface(whole, grey, f"{title}, all of {far_m:.0f} m", files))
    return entry, shown


def _rasters(
    fused: Fused, greys: Sequence[NDArray[np.uint8]], place: Path, crs: str, site: Site | None
) -> dict[str, str]:
    """Write GeoTIFFs of each level, and what joins them; returns their names by kind."""
    levels, names = fused.levels, dict[str, str]()
    for k, (level, grey) in enumerate(zip(levels, greys, strict=True)):
        for kind in ("dem", "orthoimage"):
            names[f"{kind}_{k}" if k else kind] = f"{kind}_{k}.tif" if k else _FILES[kind]
        write_dem(level, place / names[f"dem_{k}" if k else "dem"], crs, site)
        write_orthoimage(grey, level.grid, place / names[f"orthoimage_{k}" if k else "orthoimage"], crs, site)
    if fused.coarser:
        grids = [level.grid for level in levels]
        for kind in ("dem", "orthoimage"):
            own = [file for name, file in names.items() if name.startswith(kind)]
            write_joined(grids, own, place / _FILES[f"{kind}_whole"], crs, site, dem=kind == "dem")
    return names


def _level(fused: Fused) -> Json:
    """Where the cells of one grid lie, and how many of them are seen."""
    grid, seen = fused.grid, fused.count > 0
    return {
        "cell_m": grid.cell_m,
        "left_x_m": grid.left_m,
        "top_y_m": grid.top_m,
        "rows": grid.rows,
        "columns": grid.columns,
        "cells_seen": int(np.count_nonzero(seen)),
        "cells_filled": int(np.count_nonzero(np.isfinite(fused.height_m) & ~seen)),
    }


def _across_m(fused: Fused) -> float:
    """Width of all levels together, the longer side."""
    grids = [level.grid for level in fused.levels]
    x = [edge for g in grids for edge in (g.left_m, g.left_m + g.columns * g.cell_m)]
    y = [edge for g in grids for edge in (g.top_m, g.top_m - g.rows * g.cell_m)]
    return max(max(x) - min(x), max(y) - min(y))


def _folder_names(stops: Sequence[str]) -> dict[str, str]:
    """A folder for each stop: its id, or its number and what is left of an id that is no name of a file."""
    taken = {*_FILES.values(), TERRAIN_INDEX, TERRAIN_PAGE}
    names = dict[str, str]()
    for n, stop in enumerate(stops):
        plain = re.sub(r"[^A-Za-z0-9_-]+", "-", stop).strip("-")[:_LONGEST_NAME]
        alike = {other.lower() for other in (*taken, *names.values())}
        names[stop] = stop if stop == plain and stop.lower() not in alike else f"{n + 1:03d}_{plain or 'x'}"
    return names


def _limits(grey: NDArray[np.float32]) -> tuple[float, float]:
    """The darkest and the brightest sample of a picture, but for a few."""
    seen = np.isfinite(grey)
    dark, bright = np.quantile(grey[seen], _STRETCH) if seen.any() else (0.0, 1.0)
    return float(dark), float(bright)


def _stretched(grey: NDArray[np.float32], limits: tuple[float, float]) -> NDArray[np.uint8]:
    """Brightness from 1 to 255, 0 where nothing is seen."""
    dark, bright = limits
    scaled = 1 + 254 * (np.nan_to_num(grey) - dark) / max(bright - dark, 1e-6)
    return np.where(np.isfinite(grey), np.clip(np.rint(scaled), 1, 255), 0).astype(np.uint8)


def _save(path: Path, picture: Picture) -> None:
    path.write_bytes(encoded(picture, path.suffix))


def _both(terrain: Terrain, *, same_stop: bool | None) -> Json:
    return {
        pointing: _number(terrain.agreement.median_m(pointing, same_stop=same_stop))
        for pointing in ("telemetry", "refined")
    }


def _pairs(terrain: Terrain, traverse: Traverse) -> list[Json]:
    return [
        {
            "frames": [traverse.frames[f].id for f in pair.frames],
            "cells": pair.cells,
            "telemetry_m": _number(pair.telemetry_m),
            "refined_m": _number(pair.refined_m),
            "refined_sigmas": _number(pair.refined_sigmas),
        }
        for pair in terrain.agreement.pairs
    ]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
