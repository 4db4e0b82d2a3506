"""Outputs of an earlier run: what may be replaced, and what somebody else has put there."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pancam_graph.base.errors import InputError
from pancam_graph.io import MOSAIC_FORMAT, SOLUTION_FORMAT, TERRAIN_FORMAT, VERSION, read_json
from pancam_graph.results._exported import require_export

__all__ = [
    "EXPORT_FOLDER",
    "MOSAIC_FOLDER",
    "ONE_FILE",
    "SOLUTION_FILE",
    "TERRAIN",
    "TERRAIN_FOLDER",
    "Older",
]


TERRAIN = "terrain"
"""Name of the output that may also be added to older results."""


def _nothing(path: Path, expected: str) -> None:
    """Any content will do."""


@dataclass(frozen=True, kw_only=True)
class Older:
    """How an output of an earlier run is recognised."""

    strangers: Callable[[Path], list[str]]
    """Names of what is at the path, or in the folder there, that no run of ours wrote."""
    is_folder: bool = False
    """Whether the output is a folder."""
    require: Callable[[Path, str], None] = _nothing
    """Raise InputError, beginning with the text, unless the content is of ours."""


def _not_a_file(path: Path) -> list[str]:
    return [] if path.is_file() else [path.name]


def _not_a_folder(path: Path) -> list[str]:
    return [] if path.is_dir() else [path.name]


def _require_solution(path: Path, expected: str) -> None:
    try:
        read_json(path, SOLUTION_FORMAT, VERSION)
    except InputError as error:
        raise InputError(f"{expected}, found a solution.json that is none of ours: {error}") from error


def _no_mosaics(folder: Path) -> list[str]:
    """Names in a folder that its index does not know as mosaics; all where there is no index."""
    from pancam_graph.mosaic import MOSAIC_INDEX, MOSAIC_PAGE  # noqa: PLC0415  it imports OpenCV

    names = sorted(p.name for p in folder.iterdir()) if folder.is_dir() and not folder.is_symlink() else [""]
    try:
        index = read_json(folder / MOSAIC_INDEX, MOSAIC_FORMAT, VERSION)
    except InputError:
        known = set[str]()
    else:
        known = {MOSAIC_INDEX, MOSAIC_PAGE}
        for entry in index["mosaics"] if isinstance(index.get("mosaics"), list) else []:
            files = entry.get("files") if isinstance(entry, dict) else None
            known |= {f for f in files.values() if isinstance(f, str)} if isinstance(files, dict) else set()
    return [f"{folder.name}/{n}" for n in names if n not in known or not (folder / n).is_file()]


def _no_terrain(folder: Path) -> list[str]:
    """Files in a folder, and in its folders, that its index does not know; all where there is no index."""
    from pancam_graph.terrain import TERRAIN_INDEX, TERRAIN_PAGE  # noqa: PLC0415  it imports OpenCV

    if folder.is_symlink() or not folder.is_dir():
        return [f"{folder.name}/"]
    try:
        index = read_json(folder / TERRAIN_INDEX, TERRAIN_FORMAT, VERSION)
    except InputError:
        known = set[str]()
    else:
        known = {TERRAIN_INDEX, TERRAIN_PAGE}
        for entry in index["products"] if isinstance(index.get("products"), list) else []:
            files = entry.get("files") if isinstance(entry, dict) else None
            known |= {f for f in files.values() if isinstance(f, str)} if isinstance(files, dict) else set()
    found = sorted(p for p in folder.rglob("*") if p.is_symlink() or not p.is_dir())
    names = [p.relative_to(folder).as_posix() for p in found]
    # GDAL, and so QGIS, keeps statistics of a raster beside it.
    return [f"{folder.name}/{n}" for n in names if n.removesuffix(".aux.xml") not in known]


ONE_FILE = Older(strangers=_not_a_file)
"""A file of any content."""
SOLUTION_FILE = Older(strangers=_not_a_file, require=_require_solution)
EXPORT_FOLDER = Older(strangers=_not_a_folder, is_folder=True, require=require_export)
"""A folder that lists its own files in `export.json`."""
MOSAIC_FOLDER = Older(strangers=_no_mosaics, is_folder=True)
"""A folder that lists its own files in its index."""
TERRAIN_FOLDER = Older(strangers=_no_terrain, is_folder=True)
"""A folder that lists its own files, and those of its folders, in its index."""
