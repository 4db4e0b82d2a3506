"""Terrain as an output of the folder of results, written with the others or later."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pancam_graph import report
from pancam_graph.base.errors import InputError
from pancam_graph.base.whole_files import whole_folder
from pancam_graph.data import Traverse
from pancam_graph.images import cache_folder
from pancam_graph.results._older import TERRAIN, TERRAIN_FOLDER
from pancam_graph.results._output import OutputWriter, Written
from pancam_graph.terrain import (
    TERRAIN_PAGE,
    Drive,
    Terrain,
    TerrainOptions,
    WrittenTerrain,
    drive_of,
    make_terrain,
    require_extra,
    write_terrain,
)

__all__ = ["TERRAIN_WRITER", "write_terrain_of"]


def write_terrain_of(
    drive: Drive,
    out: Path | str,
    options: TerrainOptions = TerrainOptions(),  # noqa: B008  frozen
    *,
    progress: Callable[[str, int, int], None] | None = None,
    client: Any = None,
) -> Terrain:
    """Write the terrain of a drive into the folder of results `out`, whole; an older one is replaced.

    `drive` is what `read_drive` gives; `client` is as of `make_terrain`. Raises InputError as `make_terrain`
    and `write_terrain` do, for other things in the place of the terrain, and where writing fails.
    """
    require_extra()
    path = Path(out) / TERRAIN
    strangers = TERRAIN_FOLDER.strangers(path) if path.exists() or path.is_symlink() else []
    if strangers:
        raise InputError(
            f"{path}: expected an older terrain or nothing, found other things in it: {strangers[0]}"
        )
    terrain = make_terrain(drive, options, progress=progress, cache=cache_folder(out), client=client)
    try:
        with whole_folder(path) as folder:
            _fill(terrain, drive.traverse, folder, options, progress)
    except OSError as error:
        raise InputError(f"{path}: expected a place where terrain can be written, found: {error}") from error
    return terrain


def _fill(
    terrain: Terrain,
    traverse: Traverse,
    folder: Path,
    options: TerrainOptions,
    progress: Callable[[str, int, int], None] | None,
) -> WrittenTerrain:
    """Write the files of terrain, and the page that shows them, into an empty folder."""
    shown = write_terrain(terrain, traverse, folder, options, progress=progress)
    report.write_terrain_page(shown, traverse.name, folder / TERRAIN_PAGE)
    return shown


def _write(written: Written, folder: Path) -> Written:
    options, solution = written.terrain_options, written.solution
    assert options is not None  # without options nobody asked for terrain
    try:
        drive, cache = drive_of(solution), cache_folder(written.out)
        made = partial(make_terrain, drive, options, progress=written.progress, cache=cache)
        terrain = written.made_with_workers(lambda client: made(client=client))
        shown = _fill(terrain, solution.traverse, folder, options, written.progress)
        warnings = shown.warnings
    except InputError as error:  # a solve that took long must not be lost for it
        shown, warnings = None, (str(error),)
        folder.rmdir()
    warned = replace(solution, warnings=(*solution.warnings, *warnings))
    return replace(written, solution=warned, terrain=shown)


TERRAIN_WRITER = OutputWriter(write=_write)
