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
from pancam_graph.terrain._geotiff import BANDS, crs_wkt, write_dem, write_orthoimage
from pancam_graph.terrain._make import Cloud, Fused, Terrain
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
    "hillshade": "hillshade.png",
    "slope": "slope.png",
    "mesh": "mesh.glb",
    "cloud": "cloud.laz",
    "cloud_ply": "cloud.ply",
}
_STRETCH = 0.005, 0.995
_LONGEST_NAME = 60

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
    products, surfaces = [], []
    for n, (stop, name, fused, clouds) in enumerate(sets):
        place = folder / name if name else folder
        place.mkdir(exist_ok=True)
        title = f"traverse {traverse.name}" if stop is None else f"stop {stop}"
        product, surface = _write_set(fused, clouds, place, name, stop, title, crs, site, options)
        products.append(product)
        if stop is None or len(terrain.stops) > 1:
            surfaces.append(surface)
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
) -> tuple[Json, ShownSurface]:
    """Write the files of one surface; returns its entry in the index, and what a report shows of it."""
    grey = _stretched(fused.grey)
    write_dem(fused, place / _FILES["dem"], crs, site)
    write_orthoimage(grey, fused.grid, place / _FILES["orthoimage"], crs, site)
    _save(place / _FILES["hillshade"], hillshade_picture(fused, title))
    _save(place / _FILES["slope"], slope_picture(fused, title))
    triangles = write_mesh(fused, grey, place / _FILES["mesh"], options.most_mesh_cells)
    points = write_cloud(clouds, place / _FILES["cloud"], crs, site)
    if options.ply:
        write_ply(clouds, place / _FILES["cloud_ply"], site)
    written = {kind: file for kind, file in _FILES.items() if kind != "cloud_ply" or options.ply}
    files = {kind: f"{name}/{file}" if name else file for kind, file in written.items()}
    seen = np.isfinite(fused.height_m)
    grid = fused.grid
    entry: Json = {
        "stop": stop,
        "files": files,
        "bands": list(BANDS),
        "left_x_m": grid.left_m,
        "top_y_m": grid.top_m,
        "rows": grid.rows,
        "columns": grid.columns,
        "cells_seen": int(np.count_nonzero(seen)),
        "frames": sorted({int(f) for c in clouds for f in np.unique(c.frame)}),
        "points": points,
        "triangles": triangles,
        "median_sigma_m": _number(float(np.median(fused.sigma_m[seen]))),
    }
    return entry, shown_surface(fused, grey, title, files)


def _folder_names(stops: Sequence[str]) -> dict[str, str]:
    """A folder for each stop: its id, or its number and what is left of an id that is no name of a file."""
    taken = {*_FILES.values(), TERRAIN_INDEX, TERRAIN_PAGE}
    names = dict[str, str]()
    for n, stop in enumerate(stops):
        plain = re.sub(r"[^A-Za-z0-9_-]+", "-", stop).strip("-")[:_LONGEST_NAME]
        alike = {other.lower() for other in (*taken, *names.values())}
        names[stop] = stop if stop == plain and stop.lower() not in alike else f"{n + 1:03d}_{plain or 'x'}"
    return names


def _stretched(grey: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Brightness from 1 to 255, 0 where nothing is seen."""
    seen = np.isfinite(grey)
    dark, bright = np.quantile(grey[seen], _STRETCH) if seen.any() else (0.0, 1.0)
    scaled = 1 + 254 * (np.nan_to_num(grey) - dark) / max(float(bright - dark), 1e-6)
    return np.where(seen, np.clip(np.rint(scaled), 1, 255), 0).astype(np.uint8)


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
