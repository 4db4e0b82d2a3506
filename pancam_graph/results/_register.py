"""Stops of a folder of results found on an orbital picture, and the ties that hold them there."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pancam_graph.base.errors import InputError
from pancam_graph.data import StopPlacement
from pancam_graph.images import cache_folder
from pancam_graph.io import read_map_image, read_surface
from pancam_graph.results._refined_drive import read_drive
from pancam_graph.results._solution_json import read_solution_json
from pancam_graph.results._solved_folder import SOLUTION_JSON
from pancam_graph.terrain import (
    CELLS_PER_PIXEL,
    Registration,
    TerrainOptions,
    make_terrain,
    register_stop,
)

__all__ = ["Registered", "register"]

_REACH_M = 25.0
"""Ground that is compared: farther away a view from the side shows too little."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Registered:
    """What of a drive was found on a map."""

    found: tuple[Registration, ...]
    ties: tuple[StopPlacement, ...]
    """One a stop that was found; of a stop that the traverse holds (sigma 0) with its roll and pitch."""
    missing: tuple[str, ...]
    """A sentence for each stop that was not."""


def register(
    out: Path | str,
    map_file: Path | str,
    dem_file: Path | str | None = None,
    *,
    images: Path | str | None = None,
    search_m: float = 15.0,
    search_rad: float = 0.1,
    progress: Callable[[str, int, int], None] | None = None,
) -> Registered:
    """Find every stop of a folder of results on a map, by its view from above.

    `map_file` is a GeoTIFF with brightness in its first band, `dem_file` one with heights, to which stops are
    tied too; `images` is the folder that was refined, None: where it was then. A stop may lie `search_m` off
    along x and y, and be turned by `search_rad`. Raises InputError where no stop is found, for maps of
    another body or without a known place, and as `read_drive` and `make_terrain` do.
    """
    out = Path(out)
    drive = read_drive(out, None if images is None else Path(images))
    site = drive.traverse.site
    path = out / SOLUTION_JSON
    poses = {
        stop.id: stop.world_T_mast.pose(f"{path}: stops: {stop.id}")
        for stop in read_solution_json(path).stops
        if stop.world_T_mast is not None
    }
    near_m = np.array([pose.translation()[:2] for pose in poses.values()]).reshape(-1, 2)
    image = read_map_image(Path(map_file), near_m, site)
    surface = None if dem_file is None else read_surface(Path(dem_file), near_m, site)
    pixel_m = float(np.abs(image.step_m).mean())
    options = TerrainOptions(cell_m=pixel_m / CELLS_PER_PIXEL, reach_m=_REACH_M)
    terrain = make_terrain(drive, options, progress=progress, cache=cache_folder(out))
    found, missing = list[Registration](), list[str]()
    for number, (stop, view) in enumerate(terrain.stops.items()):
        at_m = poses[stop].translation()[:2]
        try:
            one = register_stop(
                stop, view, at_m, image, surface=surface, search_m=search_m, search_rad=search_rad
            )
            found.append(one)
        except InputError as error:
            missing.append(str(error))
        if progress is not None:
            progress("registering", number + 1, len(terrain.stops))
    if not found:
        raise InputError(f"{map_file}: {missing[0]}")
    held = {stop.id for stop in drive.traverse.stops if not stop.sigmas.any()}
    ties = tuple(
        one.constraint(poses[one.stop], held=one.stop in held, robust=one.stop not in held) for one in found
    )
    return Registered(found=tuple(found), ties=ties, missing=tuple(missing))
